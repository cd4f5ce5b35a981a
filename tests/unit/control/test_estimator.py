"""The estimator: fin velocity from the lateral force, tail beats from the reversals."""

import math
from itertools import pairwise
from typing import Literal

import numpy as np
import pytest
from rigs.harness import Rig

from fishd.control.estimators.base import TailBeat
from fishd.control.estimators.lateral_force import LateralForceEstimator
from fishd.core.estimation import EstimatorSettings
from fishd.core.signals import Measurement

DT = 0.05


def correlation(rig: Rig, seconds: float) -> float:
    """Return the correlation of the estimated and the true fin velocity."""
    ticks = rig.run_for(seconds)
    estimated = [tick.fin_velocity for tick in ticks]
    true = [tick.alpha_rate for tick in ticks]
    return float(np.corrcoef(estimated, true)[0, 1])


@pytest.mark.parametrize("frequency", [1.0, 1.7, 2.5])
def test_the_fin_velocity_follows_the_true_one(frequency: float) -> None:
    rig = Rig().start("square", frequency=frequency)
    rig.run_for(10)
    assert correlation(rig, 20) > 0.97


def test_an_offset_of_the_sensor_is_estimated_and_subtracted() -> None:
    rig = Rig("simulation.offset_y=0.05", "simulation.drift=0.02").start("square", frequency=1.7)
    rig.run_for(10)
    ticks = rig.run_for(20)
    mean = sum(tick.fin_velocity for tick in ticks) / len(ticks)
    top = max(abs(tick.fin_velocity) for tick in ticks)
    assert abs(mean) < 0.05 * top


def test_the_force_rate_is_the_change_over_the_time_between_ticks() -> None:
    estimator = LateralForceEstimator(EstimatorSettings())
    estimator.update(Measurement(0.0, 0.0, 0.010, 10), 0.0, 0.0, DT)
    observation = estimator.update(Measurement(0.1, 0.0, 0.016, 20), 0.0, 0.1, 2 * DT)
    assert observation.fy_rate == pytest.approx(0.06)


@pytest.mark.parametrize("samples", [10, 0])
def test_a_new_zero_of_the_sensor_is_no_motion_of_the_fin(samples: int) -> None:
    """samples: samples of the first tick after the tare; with 0 it repeats the old force."""
    estimator = LateralForceEstimator(EstimatorSettings())
    for _ in range(100):
        estimator.update(Measurement(0.0, 0.0, 1.0, 10), 0.0, 0.0, DT)
    estimator.forget_zero()
    estimator.update(Measurement(0.0, 0.0, 0.0 if samples else 1.0, samples), 0.0, 0.0, DT)
    for _ in range(20):
        seen = estimator.update(Measurement(0.0, 0.0, 0.0, 10), 0.0, 0.0, DT)
        assert (seen.fin_velocity, seen.fy_rate) == (0.0, 0.0)


@pytest.mark.parametrize("leak", ["auto", 0.2])
def test_a_reversed_force_is_seen_as_if_it_had_always_been_reversed(
    leak: float | Literal["auto"],
) -> None:
    settings = EstimatorSettings(leak=leak)
    corrected, right = LateralForceEstimator(settings), LateralForceEstimator(settings)
    for tick in range(400):
        fx, fy = 0.1 * math.cos(0.6 * tick), 0.5 + 0.2 * math.sin(0.3 * tick)
        if tick == 150:
            corrected.reverse_fy()
        seen = corrected.update(Measurement(DT * tick, fx, fy, 10), 0.0, DT * tick, DT)
        wanted = right.update(Measurement(DT * tick, fx, -fy, 10), 0.0, DT * tick, DT)
        if tick >= 150:
            assert seen.fin_velocity == pytest.approx(wanted.fin_velocity)
            assert seen.fy_rate == pytest.approx(wanted.fy_rate)


def test_the_observation_has_the_previous_angle() -> None:
    estimator = LateralForceEstimator(EstimatorSettings())
    seen = [
        estimator.update(Measurement(0.1 * tick, 0.0, 0.0, 10), angle, 0.1 * tick, DT)
        for tick, angle in enumerate((0.1, 0.2, -0.3))
    ]
    angles = [(observation.previous_angle, observation.instruction_angle) for observation in seen]
    assert angles == [(0.1, 0.1), (0.1, 0.2), (0.2, -0.3)]


def test_the_side_time_is_the_time_since_the_angle_came_to_its_side() -> None:
    estimator = LateralForceEstimator(EstimatorSettings())
    angles = (0.0, 0.3, 0.1, -0.2, -0.4, 0.0, -0.4)
    times = [
        estimator.update(Measurement(DT * tick, 0.0, 0.0, 10), angle, DT * tick, DT).side_time
        for tick, angle in enumerate(angles)
    ]
    assert times == pytest.approx([0.0, DT, 2 * DT, -DT, -2 * DT, 0.0, -DT])
    for _ in range(100):
        time = estimator.update(Measurement(9.0, 0.0, 0.0, 10), -0.4, 9.0, DT).side_time
    assert time == -2.0


def test_only_measurements_and_commands_are_used() -> None:
    """A fish without a known truth swims exactly as one with it."""
    known, unknown = Rig(), Rig()
    for rig in (known, unknown):
        rig.start("swing")
    unknown.loop.robot = type(unknown.loop.robot)("blind", unknown.fish, unknown.fish)
    for a, b in zip(known.run(200), unknown.run(200), strict=True):
        assert (a.phi_c, a.fin_velocity) == (b.phi_c, b.fin_velocity)


def beats(half_periods: list[int], force: float = 0.02) -> TailBeat:
    beat = TailBeat()
    side = 1.0
    for ticks in half_periods:
        for _ in range(ticks):
            beat.update(side * 0.4, force, DT)
        side = -side
    return beat


def test_frequency_and_thrust_cover_whole_beats_only() -> None:
    beat = TailBeat()
    forces = []
    for k in range(200):
        side = 1.0 if k % 12 < 6 else -1.0
        forces.append(0.02 + 0.5 * math.sin(k * math.tau / 6))  # ripples twice a beat
        beat.update(side, forces[-1], DT)
    assert beat.frequency == pytest.approx(1 / 0.6)
    assert beat.thrust == pytest.approx(0.02)


def test_before_the_first_whole_beat_there_is_no_frequency() -> None:
    assert beats([30, 5, 1]).frequency == 0.0
    assert beats([30, 5, 5, 1]).frequency == pytest.approx(2.0)


def test_a_stopped_tail_is_detected_after_twice_its_longest_half_beat() -> None:
    assert beats([5] * 10 + [11]).frequency > 0.0
    assert beats([5] * 10 + [14]).frequency == 0.0


@pytest.mark.parametrize("angle", [0.0, 0.4])
def test_the_time_that_a_tail_stood_still_is_not_a_half_beat(angle: float) -> None:
    beat = beats([5] * 10)
    for _ in range(1200):
        beat.update(angle, 0.02, DT)
    seen = []
    for k in range(25):
        beat.update(-0.4 if k // 5 % 2 else 0.4, 0.02, DT)
        seen.append(beat.frequency)
    assert {round(frequency, 3) for frequency in seen} == {0.0, 2.0}


def test_a_tail_that_is_brought_to_rest_does_not_beat_and_keeps_its_mean_force() -> None:
    beat = beats([5] * 10)
    thrust = beat.thrust
    beat.rest()
    assert (beat.frequency, beat.thrust) == (0.0, thrust)
    for angle in (0.3, 0.2, 0.1, 0.0, 0.0):
        beat.update(angle, 0.02, DT)
        assert beat.frequency == 0.0


def test_neutral_between_two_sides_is_no_reversal() -> None:
    beat = TailBeat()
    for angle in ([0.4] * 5 + [0.0] + [0.4] * 5 + [-0.4] * 5 + [0.0] * 6) * 8:
        beat.update(angle, 0.02, DT)
    assert beat.frequency == pytest.approx(1 / (22 * DT))


def test_while_the_tail_rests_the_thrust_is_a_slow_average() -> None:
    beat = TailBeat()
    values = []
    for _ in range(200):
        beat.update(0.0, 0.01, DT)
        values.append(beat.thrust)
    assert all(b >= a for a, b in pairwise(values))
    assert values[-1] == pytest.approx(0.01, rel=1e-3)
