"""Thrust is separated from any drift of the force sensor, with an interval that holds."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace

from fishd.config import Config, load
from fishd.core.errors import ParameterError
from fishd.lab import drift
from fishd.lab.disturbances import spell
from fishd.lab.measurement import (
    MAX_BLOCKS,
    Sample,
    Step,
    ThrustMeasurement,
    evaluate,
    measure,
    plan,
    to_samples,
)
from fishd.lab.session import Disturbed, VirtualSession
from fishd.lab.simulation import simulate

RIG = load(None, ["simulation.rotation=0.05", "simulation.offset_y=0.01"])
DRIFTS = {
    "none": {},
    "a sine of 60 s": {"drift": 5e-3},
    "a sine of 20 s": {"drift": 5e-3, "drift_period": 20.0},
    "a walk": {"drift_walk": 5e-4},
    "a line": {"drift_rate": 2e-4},
}


@cache
def truth() -> float:
    """Return the true thrust of the fish with `swing`, independent of its turned sensor [N]."""
    return simulate(RIG, "swing", {}).mean_thrust


def measure_swim(
    config: Config, seconds: float = 30.0, controller: str = "swing"
) -> ThrustMeasurement:
    with VirtualSession(config) as rig:
        return measure(rig, controller, {}, seconds)


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIFTS)
def test_the_interval_holds_the_true_thrust_whatever_the_drift(name: str) -> None:
    misses = 0
    for seed in range(8):
        config = replace(RIG, simulation=replace(RIG.simulation, seed=seed, **DRIFTS[name]))
        measurement = measure_swim(config)
        assert measurement.thrust == pytest.approx(truth(), abs=1.5e-3)
        assert measurement.total_ci95
        misses += abs(measurement.thrust - truth()) > measurement.total_ci95
    assert misses <= 2  # of 8; one in twenty is expected


def test_a_drift_that_the_plain_average_falls_for_is_taken_off() -> None:
    config = replace(RIG, simulation=replace(RIG.simulation, drift_rate=1e-3))
    measurement = measure_swim(config)
    plain = np.mean([tick.fx for tick in measurement.ticks if tick.mode == "running"])
    assert plain > measurement.thrust + 10e-3
    assert measurement.thrust == pytest.approx(measure_swim(RIG).thrust, abs=0.2e-3)
    assert measurement.drift[-1] - measurement.drift[0] == pytest.approx(
        1e-3 * (measurement.blocks.time[-1] - measurement.blocks.time[0]), rel=0.05
    )


def test_a_fish_that_holds_still_has_no_thrust() -> None:
    measurement = measure_swim(RIG, controller="hold")
    assert abs(measurement.thrust) < max(measurement.thrust_ci95, 0.3e-3)
    assert measurement.frequency == 0.0


@pytest.mark.parametrize(("seconds", "frequency"), [(30.0, 1.7), (60.0, 0.4), (21.0, 3.0)])
def test_a_plan_takes_its_time_from_rest_to_rest(seconds: float, frequency: float) -> None:
    phases = plan(seconds, {"frequency": frequency})
    assert sum(length for _, length in phases) == pytest.approx(seconds)
    assert [swims for swims, _ in phases] == [False, *[True, False] * (len(phases) // 2)]
    assert min(length for swims, length in phases if swims) > 3.0 / frequency + 1.0


def test_swims_and_rests_differ_in_length_so_that_no_drift_keeps_time_with_them() -> None:
    lengths = [length for _, length in plan(60.0, {})]
    for group in (lengths[::2], lengths[1::2]):
        assert max(group) > 1.5 * min(group)
        assert len({round(length, 2) for length in group}) == len(group)


@pytest.mark.parametrize("seconds", [10.0, float("nan"), float("inf"), -1.0, 1e9])
def test_a_length_that_is_not_possible_is_told_with_what_is_needed(seconds: float) -> None:
    with pytest.raises(ParameterError, match=r"20\.25 to 3600 s are needed, for two or more"):
        plan(seconds, {})


def test_a_fault_in_the_middle_ends_the_measurement_and_says_which() -> None:
    with VirtualSession(RIG) as rig:
        rig.rest(1.0)
        rig._run.loop.estop("emergency stop")
        with pytest.raises(Disturbed, match=r"was to rest, but it is in mode estop \(emergency"):
            rig.rest(1.0)


def test_a_force_that_is_not_to_be_believed_spoils_no_measurement() -> None:
    measurement = measure_swim(RIG)
    ticks = [
        replace(tick, fx=tick.fx + 5.0, suspect="clipped") if tick.seq % 97 == 0 else tick
        for tick in measurement.ticks
    ]
    again = evaluate(to_samples(ticks), RIG.tick)
    assert again.thrust == pytest.approx(measurement.thrust, abs=measurement.thrust_ci95)
    assert again.thrust_ci95 < 3.0 * measurement.thrust_ci95


@cache
def measure_undisturbed(seconds: float) -> ThrustMeasurement:
    return measure_swim(replace(RIG, simulation=replace(RIG.simulation, seed=77)), seconds)


def measure_disturbed(seconds: float, force: Callable[[float, bool], float]) -> ThrustMeasurement:
    """Return a measurement to whose F_x a force of time and swimming is added."""
    ticks = measure_undisturbed(seconds).ticks
    return evaluate(
        to_samples(
            replace(
                tick,
                fx=tick.fx + force((tick.seq - ticks[0].seq) * RIG.tick, tick.mode == "running"),
            )
            for tick in ticks
        ),
        RIG.tick,
    )


@pytest.mark.parametrize("at", [8.0, 13.5, 14.3, 22.0])  # in swims, before one, in a rest
def test_a_step_of_the_zero_is_found_and_accounted_for(at: float) -> None:
    clean = measure_undisturbed(30.0)
    measurement = measure_disturbed(30.0, lambda time, _: 5e-3 * (time > at))
    (step,) = [
        disturbance for disturbance in measurement.disturbances if disturbance.kind == "step"
    ]
    assert step.size == pytest.approx(5e-3, abs=1e-3)
    assert step.time == pytest.approx(at, abs=1.5)
    error = abs(measurement.thrust - clean.thrust)
    assert error < measurement.thrust_ci95 < 2.0 * clean.thrust_ci95
    assert measurement.drift[-1] - measurement.drift[0] == pytest.approx(5e-3, abs=1e-3)
    assert "the zero stepped by +" in spell(measurement.disturbances, "N")


@pytest.mark.parametrize("at", [6.0, 11.0])  # in a swim, in a rest
def test_a_tick_far_off_is_found_and_hardly_moves_the_thrust(at: float) -> None:
    clean = measure_undisturbed(30.0)
    measurement = measure_disturbed(30.0, lambda time, _: 0.1 * (abs(time - at) < 0.02))
    (outlier,) = measurement.disturbances
    assert outlier.kind == "outlier"
    assert outlier.time == pytest.approx(at, abs=0.6)
    error = abs(measurement.thrust - clean.thrust)
    assert error < measurement.thrust_ci95 < 1.3 * clean.thrust_ci95


def test_a_zero_that_follows_swimming_is_named_and_not_taken_for_thrust() -> None:
    level = 0.0

    def follow(_: float, swims: bool) -> float:
        nonlocal level
        level += (swims - level) * RIG.tick / 10.0
        return 4e-3 * level

    measurement = measure_disturbed(60.0, follow)
    (response,) = measurement.disturbances
    assert response.kind == "response"
    assert response.size == pytest.approx(4e-3, rel=0.3)
    assert abs(measurement.thrust - truth()) < measurement.thrust_ci95 < 0.5e-3


def test_nothing_is_named_where_the_zero_holds_still() -> None:
    assert not measure_undisturbed(30.0).disturbances
    assert not measure_undisturbed(60.0).disturbances
    assert not measure_undisturbed(60.0).remark


def test_a_zero_with_too_many_disturbances_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fishd.lab.disturbances.MAX_DISTURBANCES", 1)
    disturbed = measure_disturbed(30.0, lambda time, _: 5e-3 * (time > 8.0))
    assert "disturbed too often" in disturbed.remark


def make_candidate(generator: np.random.Generator, half_beat: int) -> list[Sample]:
    """Return a swim of 2 s between rests, whose beats scatter five times as much as rests.

    half_beat: length of a half beat [ticks]
    """
    rests, swims = generator.normal(0.0, 1e-3, (2, 55)), generator.normal(0.0, 5e-3, 40)
    fx = [*rests[0], *(swims + 0.02), *rests[1]]
    power = [0.1] * 55
    watts = [*power, *generator.normal(0.5, 0.05, 40), *power]
    samples = []
    for seq in range(150):
        swim = seq - 55
        is_swimming = 0 <= swim < 40
        angle = 0.0 if not is_swimming else 0.4 if swim // half_beat % 2 else -0.4
        samples.append(Sample(seq, fx[seq], angle, angle, is_swimming, watts[seq]))
    return samples


@pytest.mark.slow
def test_where_a_swim_has_one_beat_those_of_others_say_how_sure_its_thrust_and_power_are() -> None:
    generator = np.random.default_rng(3)
    alike: list[Step] = []
    thrust_missed = power_missed = 0
    for _ in range(60):
        alike += evaluate(make_candidate(generator, 4), 0.05, 0.75, other_steps=alike).steps
        evaluation = evaluate(make_candidate(generator, 6), 0.05, 0.75, other_steps=alike)
        assert not evaluation.steps  # of one beat
        assert evaluation.power is not None
        assert evaluation.power_ci95 is not None
        thrust_missed += abs(evaluation.thrust - 0.02) > evaluation.thrust_ci95
        power_missed += abs(evaluation.power - 0.5) > evaluation.power_ci95
    assert thrust_missed <= 9  # of 60; three are expected
    assert power_missed <= 9


def test_swimming_alone_cannot_be_told_from_a_drift() -> None:
    swims = np.ones(9, dtype=bool)
    blocks = drift.Blocks(np.arange(9.0), np.ones(9), np.ones(9), swims, np.empty((9, 0)))
    with pytest.raises(ValueError, match="of rest are needed"):
        drift.fit(blocks)


@pytest.mark.slow
def test_a_fin_that_takes_its_time_is_told_and_measured_right_with_more_of_it() -> None:
    slow = replace(RIG, plant=replace(RIG.plant, xi=0.05))
    measurement = measure_swim(slow, 60.0)
    assert "the fin was not steady: its power changed by +" in measurement.remark
    with VirtualSession(slow) as rig:
        measurement = measure(rig, "swing", {}, 240.0, settle=14.0)
    truth = simulate(slow, "swing", {}, 200.0, 60.0).mean_thrust
    assert measurement.remark == ""
    assert measurement.total_ci95
    assert abs(measurement.thrust - truth) < measurement.total_ci95 < 0.02 * truth


def swim_and_rest(config: Config) -> ThrustMeasurement:
    """Return a measurement of two long swims, with the usual time for a fin to hang still."""
    with VirtualSession(config) as rig:
        ticks = rig.rest(3.0)
        for _ in range(2):
            ticks += rig.swim("swing", {}, 20.0) + rig.rest(3.0)
    return evaluate(to_samples(ticks), config.tick, 10.0)


def test_a_fin_that_still_swings_in_the_rests_is_told() -> None:
    slow = replace(RIG, plant=replace(RIG.plant, xi=0.1))
    assert "the fin did not rest: it had 2" in swim_and_rest(slow).remark


@pytest.mark.parametrize("seed", [2, 3])
def test_a_drift_of_the_lateral_force_is_not_taken_for_a_fin_that_swings_in_the_rests(
    seed: int,
) -> None:
    rig = replace(RIG.simulation, drift=20e-3, drift_period=20.0, seed=seed)
    assert "did not rest" not in measure_swim(replace(RIG, simulation=rig), 60.0).remark


def test_a_beat_that_is_longer_than_a_swim_is_told() -> None:
    slow = {"smaller": 1.0, "lowest_frequency": 0.15, "highest_frequency": 0.15}
    with VirtualSession(RIG) as rig, pytest.raises(ParameterError, match="no whole beat is left"):
        measure(rig, "excitation", slow, 30.0)


@pytest.mark.slow
def test_a_long_measurement_is_the_same_and_no_slower_to_judge() -> None:
    measurement = measure_swim(replace(RIG, simulation=replace(RIG.simulation, drift=5e-3)), 600.0)
    assert len(measurement.blocks.time) <= MAX_BLOCKS + 2 * measurement.swims + 1
    assert measurement.total_ci95
    assert abs(measurement.thrust - truth()) < 2.0 * measurement.total_ci95
    assert 2.0 * measurement.thrust_ci95 < 0.2e-3
