"""Identification of a fish from its forces, and the limits of what forces determine."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from msgspec import structs
from msgspec.structs import asdict
from rigs.harness import Rig

from fishd.config import load
from fishd.core.calibration import EXACT
from fishd.core.dataframes import ticks_to_frame
from fishd.core.errors import ParameterError
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.servo.sysfs_pwm import SysfsPwmSettings
from fishd.hardware.settings import ServoSettings
from fishd.lab.identification import (
    DEFAULT,
    Estimate,
    Identification,
    Unidentifiable,
    experiment,
    identify,
)
from fishd.lab.identification.passages import passages
from fishd.lab.identification.response import Drive, response
from fishd.lab.session import VirtualSession
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

TICK = 0.05
RIG_OVERRIDES = (
    "simulation.offset_x=0.02",
    "simulation.offset_y=0.02",
    "simulation.drift=0.005",
    "simulation.rotation=0.0873",
    "plant.omega0=11",
    "plant.servo_delay=0.04",
    "plant.backlash=0.02",
)
QUIET = "simulation.noise=0.0005"
"""Half the usual noise: a third of the ticks determines as much."""
FISH = load(None, RIG_OVERRIDES).plant
NEARLY_KNOWN = ("omega0", "servo_delay", "rotation")


def swim_experiment(*overrides: str, seconds: float = 90.0) -> pd.DataFrame:
    with VirtualSession(load(None, overrides)) as rig:
        return experiment(rig, seconds)


def noise(table: pd.DataFrame, seed: int) -> np.ndarray:
    """Return forces of a sensor without a fish [N]."""
    return 0.1 + 1e-4 * np.random.default_rng(seed).normal(size=len(table))


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """Ticks of an experiment, without the columns that a real robot does not have."""
    hidden = ["alpha", "alpha_rate", "phi", "fin_velocity"]
    return swim_experiment(*RIG_OVERRIDES).drop(columns=hidden)


@pytest.fixture(scope="module")
def identification(table: pd.DataFrame) -> Identification:
    return identify(table)


@pytest.mark.slow
def test_it_finds_fish_and_rig_from_forces_and_commands(identification: Identification) -> None:
    config = load(None, RIG_OVERRIDES)
    truth = asdict(config.plant) | asdict(config.simulation)
    for name in ("omega0", "xi", "coupling", "servo_speed", "servo_lag", "thrust_coefficient",
                 "lateral_drag", "rotation"):  # fmt: skip
        assert identification[name].value == pytest.approx(truth[name], rel=0.01), name
        assert (
            identification[name].ci95_low
            < identification[name].value
            < identification[name].ci95_high
        )
    assert identification["servo_delay"].value == pytest.approx(0.04, abs=5e-4)
    assert identification["backlash"].value == pytest.approx(0.02, abs=1e-3)
    # Forces do not determine it, so it has its configured value.
    assert identification["lateral_inertia_ratio"].value == 1.0
    assert identification.remarks == ()
    assert identification.failed_assumptions == ()
    assert identification.headline.startswith("identified: the model explains 9")
    assert identification.headline.endswith("; λ, K and K_d hold for K_y/K from 0.25 to 4")


@pytest.mark.slow
def test_products_are_told_and_factors_have_any_ratio(identification: Identification) -> None:
    truth = asdict(FISH)
    scale = truth["coupling"]
    products = [truth["thrust_coefficient"] * scale, truth["thrust_coefficient"],
                truth["lateral_drag"]]  # fmt: skip
    for product, value in zip(identification.products, products, strict=True):
        assert product.value == pytest.approx(scale * value, rel=0.01)
        assert product.ci95_high < 1.02 * product.ci95_low
    for name, factor in (("coupling", 4.0), ("thrust_coefficient", 16.0), ("lateral_drag", 4.0)):
        low, high = identification[name].narrowest_interval
        interval = identification[name].ci95_low, identification[name].ci95_high
        assert interval == pytest.approx((low / factor, high * factor))
        assert high < 1.03 * low


@pytest.mark.slow
def test_quadratic_drag_and_another_lateral_inertia_are_found() -> None:
    changes = ("plant.quadratic_drag=0.8", "plant.lateral_quadratic_drag=0.003",
             "plant.lateral_inertia_ratio=0.7")  # fmt: skip
    table = swim_experiment(*RIG_OVERRIDES, *changes, QUIET, seconds=30.0)
    truth = asdict(load(None, (*RIG_OVERRIDES, *changes)).plant)
    identification = identify(table, fix=("coupling",))
    for estimate in identification.estimates:
        if estimate.fitted and estimate.name in truth:
            width = 0.5 * (estimate.ci95_high - estimate.ci95_low)
            low, high = estimate.ci95_low - width, estimate.ci95_high + width
            assert low <= truth[estimate.name] <= high, estimate.name
    assert identification.failed_assumptions == ()
    assert identification["quadratic_drag"].value > 0.4
    assert identification["lateral_inertia_ratio"].value == pytest.approx(0.7, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["linear", "accelerating"])
def test_the_law_of_the_servo_is_found_from_the_forces(law: str) -> None:
    changes = (f"plant.servo_law={law}", "plant.servo_lag=0.15", "plant.omega0=11", QUIET)
    identification = identify(swim_experiment(*changes, seconds=30.0))
    assert identification.servo_law == law
    assert f"servo_law: {law}" in identification.to_yaml()
    assert identification.failed_assumptions == ()
    for name, value in (("omega0", 11.0), ("servo_speed", 5.8), ("servo_lag", 0.15)):
        assert identification[name].value == pytest.approx(value, rel=0.02), name


def test_a_law_that_is_wrong_is_noticed_far_below_the_noise(table: pd.DataFrame) -> None:
    # The force of one tick after each step is wrong by less than the noise.
    steps = np.abs(np.diff(table["phi_c"], prepend=0.0)) > 0.0
    late = pd.Series(steps).shift(3, fill_value=False).to_numpy()
    for size, is_noticed in ((0.0, False), (7e-4, True)):
        wrong = table.assign(fy=table["fy"] + size * late)
        failed = identify(wrong, start=FISH, fit=NEARLY_KNOWN).failed_assumptions
        assert ("white residual of fy" in failed) == is_noticed


@pytest.mark.slow
def test_what_the_forces_show_is_fitted_too_unless_that_is_fixed() -> None:
    table = swim_experiment(*RIG_OVERRIDES, "plant.servo_reaction=-0.0003", QUIET, seconds=30.0)
    identification = identify(table, start=FISH)
    assert identification.failed_assumptions == ()
    assert identification["servo_reaction"].value == pytest.approx(-0.0003, rel=0.05)
    fixed = identify(table, start=FISH, fit=NEARLY_KNOWN)
    assert fixed.failed_assumptions[0] == "servo_reaction = 0"
    assert fixed.headline.startswith("careful: the model is incomplete")
    assert "it looks as if servo_reaction is not 0" in fixed.headline
    assert fixed.inflation > 2.0


def test_a_fish_of_another_kind_is_not_identified_in_one_line(table: pd.DataFrame) -> None:
    # The forces have components that no fish of the model can have.
    chance = np.random.default_rng(0)
    table = table.iloc[:600]
    strange = table.assign(
        fx=table["fx"] + 0.05 * np.sign(table["phi_c"]).shift(3, fill_value=0.0),
        fy=table["fy"] * (1.0 + 0.5 * np.tanh(20.0 * table["fy"])) + 1e-3 * chance.normal(),
    )
    identification = identify(strange, start=FISH, fit=NEARLY_KNOWN)
    assert not identification.identified
    assert identification.headline.startswith("not identified: the model explains ")
    white = {"white residual of fx", "white residual of fy"}
    assert white <= set(identification.failed_assumptions)
    assert min(channel.explained_out_of_sample for channel in identification.channels) < 0.9
    assert (identification["omega0"].ci95_low, identification["omega0"].ci95_high) == (
        0.0,
        math.inf,
    )
    assert identification.to_builtins()["estimates"]["omega0"]["ci95_high"] is None
    assert identification.covariance[0, 0] > 0.0
    assert "# not identified" in identification.to_yaml()


@pytest.mark.slow
def test_delay_and_backlash_are_known_to_10_percent_at_best_where_they_are() -> None:
    with VirtualSession(load(None, [*RIG_OVERRIDES, "simulation.noise=0.01"])) as rig:
        ticks = rig.swim("sine", {"frequency": 1.0, "amplitude": 0.1}, 15.0)
    chosen = ("servo_delay", "backlash", "rotation")
    identification = identify(ticks_to_frame(ticks), start=FISH, fit=chosen)
    remark = next(text for text in identification.remarks if text.startswith("known to 10 %"))
    assert "servo_delay" in remark
    assert "backlash" in remark


@pytest.mark.slow
def test_offsets_of_the_sensor_are_told_from_its_drift(identification: Identification) -> None:
    # One period and a half of a drift of 5 mN: its mean is within 2 π of a third.
    assert abs(identification["offset_y"].value - 0.02) < 5e-3 / 2
    drifts = [channel.drift for channel in identification.channels]
    assert drifts == pytest.approx([0.010, 0.010], rel=0.1)
    noises = [channel.noise for channel in identification.channels]
    assert noises == pytest.approx([1e-3, 1e-3], rel=0.05)


@pytest.mark.slow
def test_what_it_writes_is_a_configuration(identification: Identification, tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text(identification.to_yaml("a test"), encoding="utf-8")
    config = load(file)
    written = asdict(config.plant) | asdict(config.simulation)
    assert set(identification.plant) == set(asdict(config.plant)) - {"model"}  # that of the paper
    ratio = identification["thrust_coefficient"].value / identification["lateral_drag"].value
    assert config.estimator.leak == pytest.approx(ratio, rel=1e-3)
    for estimate in identification.estimates:
        error = abs(written[estimate.name] - estimate.value)
        assert error <= 0.01 * (estimate.ci95_high - estimate.ci95_low), estimate.name


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "seconds"), [(0, 135.0), (1, 180.0)])
def test_the_interval_of_an_offset_knows_the_mean_drift(seed: int, seconds: float) -> None:
    table = swim_experiment(*RIG_OVERRIDES, f"simulation.seed={seed}", seconds=seconds)
    rig = load(None, RIG_OVERRIDES).simulation
    identification = identify(table, start=FISH, rig=rig, fit=["coupling"])
    for name in ("offset_x", "offset_y"):
        assert identification[name].ci95_low < 0.02 < identification[name].ci95_high, name


@pytest.mark.parametrize("seconds", [5.0, math.nan, math.inf])
def test_an_experiment_takes_half_a_minute_or_more_and_ends(seconds: float) -> None:
    short = pytest.raises(ParameterError, match="30 s or more are needed")
    with VirtualSession(load()) as rig, short:
        experiment(rig, seconds)


@pytest.mark.slow
def test_the_configuration_has_no_false_digits(table: pd.DataFrame, tmp_path: Path) -> None:
    identification = identify(table.iloc[:400], start=FISH, fit=["coupling"])
    others = tuple(one for one in identification.estimates if one.name != "servo_delay")
    delay = Estimate("servo_delay", 3.9e-14, 0.0, 4e-5)
    identification = replace(identification, estimates=(delay, *others))
    file = tmp_path / "fish.yaml"
    file.write_text(identification.to_yaml(), encoding="utf-8")
    assert "servo_delay: 0  # 0 to 4e-05 s" in file.read_text(encoding="utf-8")


def test_gaps_and_skipped_slots_cost_only_what_is_missing(table: pd.DataFrame) -> None:
    lost = table.drop(index=range(700, 720)).drop(index=range(1200, 1201))
    identification = identify(lost, start=FISH, fit=NEARLY_KNOWN)
    assert identification.passages == 3
    assert identification["omega0"].value == pytest.approx(11.0, rel=0.01)
    assert identification["servo_delay"].value == pytest.approx(0.04, abs=1e-3)
    assert all(channel.white for channel in identification.channels)


def test_a_force_that_is_not_to_be_believed_is_left_out(table: pd.DataFrame) -> None:
    clipped = table.copy()
    doubted = clipped.index % 400 == 399
    clipped.loc[doubted, "fy"] += 50.0
    clipped["suspect"] = np.where(doubted, "a sample is clipped", None)
    parts = passages([clipped])
    assert len(parts) == 5
    assert sum(part.duration for part in parts) == pytest.approx(90.0, abs=1.0)
    assert max(float(abs(part.forces).max()) for part in parts) < 10.0


def test_slots_that_were_skipped_are_part_of_a_longer_window() -> None:
    rig = Rig(*RIG_OVERRIDES)
    rig.start("excitation")
    for _ in range(30):
        rig.run(1, missed=3)
        rig.run(29)
    identification = identify(ticks_to_frame(rig.recorder.ticks), start=FISH, fit=NEARLY_KNOWN)
    assert identification.passages == 1
    assert identification.seconds == pytest.approx(30 * 33 * TICK, abs=0.2)
    assert identification["omega0"].value == pytest.approx(11.0, rel=0.01)
    assert identification["servo_delay"].value == pytest.approx(0.04, abs=1e-3)


def test_what_is_not_fitted_is_as_the_configuration_says(table: pd.DataFrame) -> None:
    config = load(None, (*RIG_OVERRIDES, "plant.servo_reaction=1e-7", "plant.quadratic_drag=1e-3"))
    fish = {"start": config.plant, "rig": config.simulation}
    identification = identify(table.iloc[:900], **fish, fit=["omega0", "xi"])
    assert identification["rotation"].value == config.simulation.rotation
    assert not identification["rotation"].fitted
    assert identification["omega0"].ci95_low < 11.0 < identification["omega0"].ci95_high
    assert all(channel.white for channel in identification.channels)
    assert identification.plant["servo_reaction"] == 1e-7
    assert identification.plant["quadratic_drag"] == 1e-3


@pytest.mark.slow
def test_the_reaction_of_the_servo_is_found_where_it_is_asked_for() -> None:
    change = ("plant.servo_reaction=-0.002", "plant.servo_dead_zone=0.02")
    table = swim_experiment(*RIG_OVERRIDES, *change, QUIET, seconds=30.0)
    identification = identify(table, fit=(*DEFAULT, "servo_reaction", "servo_dead_zone"))
    assert all(channel.white for channel in identification.channels)
    assert identification["servo_reaction"].value == pytest.approx(-0.002, rel=0.02)
    assert identification["servo_dead_zone"].value == pytest.approx(0.02, abs=1e-3)
    assert identification["omega0"].value == pytest.approx(11.0, rel=0.01)


def interval_width(identification: Identification) -> float:
    return identification["omega0"].ci95_high - identification["omega0"].ci95_low


def test_several_runs_are_one_fish(table: pd.DataFrame) -> None:
    halves = [table.iloc[:900], table.iloc[900:]]
    fits = (identify(runs, start=FISH, fit=NEARLY_KNOWN) for runs in (halves, halves[1]))
    both, second_half = fits
    assert both.passages == 2
    assert interval_width(both) < 0.8 * interval_width(second_half)


@pytest.mark.slow
def test_of_a_slow_fin_it_tells_only_the_passages_that_it_fitted() -> None:
    table = swim_experiment("plant.xi=0.3", seconds=40.0)
    short, long = table.iloc[:160], table.iloc[160:]
    identification = identify([short, long], fit=("xi",))
    assert identification.passages == 1
    assert identification.seconds == pytest.approx(TICK * (len(long) - 1))


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda t: t.drop(columns=["fy"]), "not a table of ticks: the column fy is missing"),
        (lambda t: t.iloc[:0], "there is no passage of 5 s without a gap"),
        (lambda t: t.iloc[:90], "there is no passage of 5 s without a gap"),
        (lambda t: t.assign(phi_c=0.0), "φ_c is the same in every row"),
        (lambda t: t.assign(phi_c=0.3), "φ_c is the same in every row"),
        (lambda t: t.assign(phi_c=20.0 * t.phi_c), "phi_c is .* is it in degrees"),
        (lambda t: t.assign(fx=0.0), "F_x is the same in every row"),
        (lambda t: t.assign(fy=0.1), "F_y is the same in every row"),
        (lambda t: t.assign(fx=noise(t, 1), fy=noise(t, 2)), "neither F_x nor F_y follows φ_c"),
        (lambda t: t.assign(fx=1e300), "fx is 1e\\+300 N somewhere, more than 100 N"),
        (lambda t: t.assign(fx=t.fx.map(str) + " N"), "the column fx has no numbers"),
        (lambda t: t.assign(force_age_ms=-20.0, force_span_ms=20.0), "force_age_ms is -20 and"),
        (lambda t: t.assign(force_age_ms=2e3, force_span_ms=50.0), "samples of the 500 ms before"),
        (lambda t: t.assign(time=1.0), "the times of the ticks do not increase"),
        (lambda t: t.assign(servo_on=False), "there is no passage of 5 s without a gap"),
    ],
)
def test_nothing_to_fit_is_refused(table: pd.DataFrame, spoil: object, complaint: str) -> None:
    with pytest.raises(Unidentifiable, match=complaint):
        identify(spoil(table))  # type: ignore[operator]


def test_the_law_of_the_servo_may_be_fixed(table: pd.DataFrame) -> None:
    given = structs.replace(FISH, servo_law="linear")
    fit = ("omega0", "servo_lag", "rotation")
    assert identify(table, start=given, fit=fit, fix=("servo_law",)).servo_law == "linear"
    assert identify(table, start=given, fit=fit).servo_law != "linear"


PULSED = ("omega0", "servo_speed", "servo_delay", "rotation")


def swim_with_pulses(settings: ServoSettings, phase: float, step: float) -> pd.DataFrame:
    """Return ticks of a fish whose servo takes each angle with its next pulse.

    phase: begin of a pulse after the first tick [s]; step: pulses are rounded down to it [µs]
    """
    chance = np.random.default_rng(3)
    commands = np.repeat(
        chance.choice([-0.42, -0.168, 0.168, 0.42], 90), chance.integers(4, 12, 90)
    )
    commands[:40] = 0.0
    fish = TetheredFish(FISH)
    rows, active = [], 0.0
    for number, command in enumerate(commands):
        wait = (phase - number * TICK) % settings.pulse_period
        width = round(settings.centre + settings.scale * command) // step * step
        before, active = active, (width - settings.centre) / settings.scale
        parts = [(before, wait), (active, TICK - wait)]
        windows = [(fish.advance(angle, time, 10), time) for angle, time in parts if time > 1e-9]
        fx = sum(w.thrust * time for w, time in windows) / TICK
        fy = sum(w.lateral_force * time for w, time in windows) / TICK
        rows.append((fx, fy))
    forces = np.array(rows[-1:] + rows[:-1]) + chance.normal(0.0, 1e-3, (len(rows), 2))
    ticks = np.arange(len(rows))
    columns = {"time": ticks * TICK, "seq": ticks, "missed_slots": 0, "servo_on": True}
    columns |= {"fx": forces[:, 0], "fy": forces[:, 1], "phi_c": commands, "samples": 40}
    return pd.DataFrame(columns)


@pytest.mark.parametrize(
    ("settings", "phase", "step"),
    [
        (PigpioSettings(), 3e-3, 5),  # waits of 3 and 13 ms in turn, the shorter one first
        (PigpioSettings(), 17e-3, 1),  # the longer one first
        (SysfsPwmSettings(frequency=60.0), 12e-3, 1e-9),  # each command waits 12 ms
    ],
)
def test_waits_for_pulses_and_their_rounding_are_found(
    settings: ServoSettings, phase: float, step: float
) -> None:
    table = swim_with_pulses(settings, phase, step)
    identification = identify(table, start=FISH, fit=PULSED, servo=settings)
    assert identification.headline.startswith("identified")
    waits = np.mod(phase - np.arange(len(table)) * TICK, settings.pulse_period)
    delay = FISH.servo_delay + waits.mean()
    for name, truth, error in (("omega0", FISH.omega0, 0.03), ("rotation", 0.0, 1.5e-3)):
        assert identification[name].value == pytest.approx(truth, abs=error), name
    assert identification["servo_delay"].value == pytest.approx(delay, abs=5e-4)


def test_forces_sampled_earlier_are_not_a_shorter_delay(table: pd.DataFrame) -> None:
    """The same forces, as if measured 3 ms earlier, are those of a servo with 3 ms more delay."""
    earlier = table.assign(force_age_ms=table.force_age_ms + 3.0)
    fits = [identify(runs, start=FISH, fit=NEARLY_KNOWN) for runs in (table, earlier)]
    delays = [fit["servo_delay"].value for fit in fits]
    assert delays[0] - delays[1] == pytest.approx(3e-3, abs=1e-4)


def test_implausible_ages_of_forces_do_not_count(table: pd.DataFrame) -> None:
    spoiled = table.assign(force_age_ms=1e308, force_span_ms=math.nan)
    fits = [identify(runs, start=FISH, fit=NEARLY_KNOWN) for runs in (table, spoiled)]
    assert fits[1]["servo_delay"].value == pytest.approx(fits[0]["servo_delay"].value, abs=1e-5)


@pytest.mark.slow
def test_a_fish_behind_the_drivers_of_the_robot_is_identified() -> None:
    config = load(
        None,
        ["robot=virtual-pi", "virtual_pi.pulse_lead=0.0123", "plant.servo_delay=0.02", QUIET],
    )
    with VirtualSession(config, EXACT) as session:
        ticks = experiment(session, 60.0)
        identification = identify(ticks, start=config.plant, fit=PULSED, servo=session.servo)
    assert identification.headline.startswith("identified")
    assert identification["omega0"].value == pytest.approx(12.5, abs=0.05)
    # Pulses begin 7.7 and 17.7 ms after the ticks, in turn.
    assert identification["servo_delay"].value == pytest.approx(0.0327, abs=1e-3)


def test_a_large_step_of_a_fast_servo_has_a_response() -> None:
    commands = np.repeat([-3.1, 3.1, -3.1], 20)
    drive = Drive(omega0=12.5, xi=1.2, servo_speed=5.8, servo_lag=5e-3)
    assert np.all(np.isfinite(response(drive, commands, np.arange(61), TICK, 10)))


@pytest.mark.parametrize(
    "plant",
    [
        PlantParameters(servo_delay=0.023),
        PlantParameters(servo_delay=0.05, backlash=0.03),
        PlantParameters(cable_slack=0.03, servo_dead_zone=0.02),
        PlantParameters(servo_delay=0.03, servo_reaction=5e-3),
        PlantParameters(quadratic_drag=2.0, lateral_quadratic_drag=0.01, lateral_inertia_ratio=0.7),
        PlantParameters(quadratic_drag=20.0, xi=0.2, backlash=0.02),
        PlantParameters(servo_law="linear", cable_slack=0.03, servo_dead_zone=0.02),
        PlantParameters(servo_law="square-root", servo_delay=0.03, servo_reaction=2e-3),
        PlantParameters(servo_law="accelerating", servo_lag=0.15, backlash=0.02),
    ],
)
def test_the_response_is_that_of_the_simulated_fish(plant: PlantParameters) -> None:
    chance = np.random.default_rng(1)
    commands = np.repeat(chance.uniform(-0.42, 0.42, 60), chance.integers(2, 12, 60))
    commands[:20] = 0.0
    fish = TetheredFish(plant)
    windows = [fish.advance(angle, TICK, 10) for angle in commands]
    known = {name: getattr(plant, name) for name in Drive.__dataclass_fields__}
    known["quadratic_drag"] *= plant.coupling
    a, b, c, d, e = response(Drive(**known), commands, np.arange(len(commands) + 1), TICK, 10)
    drag, scale = plant.lateral_drag, plant.coupling
    fx = plant.thrust_coefficient * scale * scale * a
    fy = plant.lateral_inertia * scale * b + drag * scale * c + plant.servo_reaction * d
    fy = fy + plant.lateral_quadratic_drag * scale * scale * e
    # Far below the noise of 1 mN; the backlash is taken up between two points of the grid.
    assert fx == pytest.approx([w.sampled_thrust for w in windows], abs=2e-5)
    assert fy == pytest.approx([w.sampled_lateral_force for w in windows], abs=1e-4)
    rms = math.sqrt(np.mean((fy - [w.sampled_lateral_force for w in windows]) ** 2))
    assert rms < (3e-5 if plant.servo_reaction else 1e-5)
