"""Runs in virtual time: repeatable to the last bit, and their figures are the plant's truth."""

import json
import math
import subprocess

import msgspec
import pytest
from processes import FISHCTL

from fishd.config import load
from fishd.controllers import registry
from fishd.errors import ParameterError
from fishd.plant.optimum import square_wave
from fishd.plant.tethered import TrueWindow
from fishd.simulation import Beats, EncodingPublisher, Report, judge, simulate

REALISTIC = ["simulation.offset_y=0.02", "simulation.drift=0.02", "simulation.rotation=0.1"]


def physics(report: Report) -> dict[str, object]:
    """A report without what depends on the machine."""
    fields = msgspec.structs.asdict(report)
    del fields["real_time_factor"], fields["microseconds_per_tick"]
    return fields


def test_the_same_seed_gives_the_same_result_to_the_last_bit() -> None:
    first, second, other = (
        simulate(load(None, [*REALISTIC, f"simulation.seed={seed}"]), "swing", {}, 30)
        for seed in (3, 3, 4)
    )
    assert physics(first) == physics(second)
    # Noise decides which tick a reversal falls on, when the reversal is close to one.
    noisy = [
        simulate(load(None, ["simulation.noise=0.02", f"simulation.seed={s}"]), "swing", {}, 30)
        for s in (3, 4)
    ]
    assert noisy[0].mean_thrust != noisy[1].mean_thrust
    assert other.mode == "running"


def test_figures_are_those_of_the_plant_and_not_of_the_sensor() -> None:
    config = load(None, ["simulation.offset_x=0.5", "simulation.noise=0"])
    report = simulate(config, "square", {"frequency": 2.0})
    truth = square_wave(config.plant, 0.42, 2.0)
    assert report.mean_thrust == pytest.approx(truth.thrust, rel=1e-6)
    assert report.fin_amplitude == pytest.approx(truth.fin_amplitude, rel=1e-4)
    assert report.frequency == pytest.approx(2.0)


def test_on_the_grid_the_best_square_wave_comes_close_to_the_optimum() -> None:
    report = simulate(load(), "square", {"frequency": 1.7089})
    assert 0.98 <= report.efficiency <= 1.0
    assert report.best_square_frequency == pytest.approx(1.7089, abs=0.005)
    assert report.best_square_thrust == pytest.approx(25.78384e-3, rel=1e-4)


def test_square_beats_sine_beats_triangle() -> None:
    thrust = {
        name: simulate(load(), name, {"frequency": 1.8}).mean_thrust
        for name in ("square", "sine", "triangle")
    }
    assert thrust["square"] > thrust["sine"] > thrust["triangle"]


def test_the_comparison_is_with_the_amplitude_that_the_controller_uses() -> None:
    report = simulate(load(), "square", {"frequency": 1.7856, "amplitude": 0.2})
    assert report.best_square_thrust == pytest.approx(6.819563e-3, rel=1e-4)
    assert report.efficiency > 0.95


def test_a_fish_that_does_not_beat_has_no_frequency_and_no_thrust() -> None:
    report = simulate(load(), "hold", {"angle": 0.3}, 30)
    assert (report.frequency, report.mean_thrust) == (0.0, pytest.approx(0.0, abs=1e-9))
    assert report.fin_amplitude == pytest.approx(0.3 * 0.46, rel=1e-3)


@pytest.mark.parametrize(("seconds", "settle"), [(math.nan, 1), (math.inf, 1), (9, -1), (1e300, 1)])
def test_a_length_that_is_no_length_is_refused(seconds: float, settle: float) -> None:
    with pytest.raises(ParameterError, match=r"numbers from 0 to 1e\+08 s are needed"):
        simulate(load(), "swing", {}, seconds, settle)


def test_slack_that_swallows_the_whole_amplitude_leaves_nothing_to_compare_with() -> None:
    report = simulate(load(None, ["plant.cable_slack=0.5"]), "square", {}, 20)
    assert (report.mean_thrust, report.efficiency) == (0.0, 0.0)


def test_a_run_that_is_too_short_to_judge_is_refused() -> None:
    with pytest.raises(ParameterError, match="nothing is left to judge: a run of 5 s"):
        simulate(load(), "swing", {}, seconds=5)


@pytest.mark.parametrize("tick", [0.002, 0.01, 0.2])
def test_the_loop_runs_at_any_tick(tick: float) -> None:
    report = simulate(load(None, [f"tick={tick}"]), "square", {"frequency": 1.25}, 20, settle=5)
    assert report.mean_thrust == pytest.approx(
        square_wave(load().plant, 0.42, 1.25).thrust, rel=1e-3
    )


def test_cable_slack_costs_thrust() -> None:
    with_slack = simulate(load(None, ["plant.cable_slack=0.1"]), "swing", {}, 30)
    assert with_slack.mean_thrust < 0.8 * simulate(load(), "swing", {}, 30).mean_thrust


def test_only_whole_beats_are_counted() -> None:
    beats = Beats()
    for angle, thrust in [(1.0, 9.0)] * 3 + [(-1.0, 1.0), (1.0, 2.0)] * 4 + [(-1.0, 9.0)]:
        beats.add(angle, TrueWindow(0.5, thrust, 0.1 * thrust))
    found = beats.figures()
    assert found[:3] == pytest.approx((1.5, 1.0, 0.15))


@pytest.mark.parametrize(
    ("waveform", "fullness", "squareness"),
    [("square", 1.0, 1.0), ("sine", 2.0 / math.pi, 0.9003), ("triangle", 0.5, 0.8660)],
)
def test_fullness_and_squareness_tell_the_waveforms_apart(
    waveform: str, fullness: float, squareness: float
) -> None:
    amplitude = 0.3
    report = simulate(
        load(None, ["tick=0.005"]), waveform, {"frequency": 1.0, "amplitude": amplitude}, 30
    )
    assert report.fullness == pytest.approx(fullness, abs=1e-3)
    assert report.squareness == pytest.approx(squareness, abs=1e-3)


def test_a_fish_at_neutral_is_neither_full_nor_square() -> None:
    report = simulate(load(), "hold", {}, 20)
    assert (report.fullness, report.squareness) == (0.0, 0.0)


def test_a_ready_made_controller_gets_the_same_report_as_one_by_name() -> None:
    config = load(None, REALISTIC)
    controller = registry.create("swing", {"C": 0.5}, config.limits)
    ready_made = judge(config, "swing", controller, 30, 10, EncodingPublisher())
    assert physics(ready_made) == physics(simulate(config, "swing", {"C": 0.5}, 30))


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [FISHCTL, "simulate", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_command_prints_json_with_the_documented_keys() -> None:
    done = run("swing", "--C", "0.6", "--seconds", "20", "--json", "--set", "simulation.noise=1e-3")
    report = json.loads(done.stdout)
    assert {
        "mean_thrust",
        "frequency",
        "fin_amplitude",
        "efficiency",
        "best_square_thrust",
        "best_square_frequency",
        "ticks",
        "real_time_factor",
    } <= set(report)
    assert report["ticks"] == 400
    assert report["efficiency"] > 0.97


@pytest.mark.parametrize(
    ("arguments", "message", "status"),
    [
        (["swim"], "fishctl: no controller is named 'swim'; did you mean 'swing'?\n", 1),
        (["swing", "--C", "2"], "fishctl: swing: C: 2.0 is not valid: a number in [0, 1]", 1),
        (["swing", "--C", "inf"], "'inf' is not valid: a number in [0, 1] is needed", 2),
        (["swing", "--set", "tick=3"], "fishctl: --set tick=3: tick: 3 is not valid", 78),
        (["swing", "--seconds", "1"], "fishctl: nothing is left to judge", 1),
        (["swing", "--config", "no.yaml"], "fishctl: no.yaml: no such file", 78),
        (["swing", "--speed", "3"], "fishctl: No such option", 2),
    ],
)
def test_a_wrong_command_gets_one_line(arguments: list[str], message: str, status: int) -> None:
    done = run(*arguments)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert (done.stdout, done.returncode) == ("", status)
