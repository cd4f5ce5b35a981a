"""The guard: only finite angles within ±Φ and the slew limit reach the servo."""

import math
from itertools import pairwise

import pytest
from fishd_zoo import BAD, GOOD
from hypothesis import given
from hypothesis import strategies as st
from rigs.harness import Rig

from fishd.control.guard import Guard

angles = st.floats(-10, 10)
amplitudes = st.floats(1e-3, 1.5)
ticks = st.floats(0.002, 0.2)
slews = st.none() | st.floats(0.5, 100)
finite = st.floats(allow_nan=False, allow_infinity=False)


@given(amplitudes, ticks, slews, st.lists(angles | finite))
def test_no_series_of_commands_passes_the_limits(
    amplitude: float, tick: float, slew: float | None, commands: list[float]
) -> None:
    guard = Guard(amplitude, tick, slew, fade_time=0.4)
    angle = 0.0
    for command in commands:
        previous, angle = angle, guard.apply(command, angle)
        assert abs(angle) <= amplitude
        assert abs(angle - previous) <= guard.step * (1 + 1e-8)


@given(amplitudes, ticks, slews, st.floats(0.01, 0.5))
def test_a_fade_reaches_neutral_and_stays_there(
    amplitude: float, tick: float, slew: float | None, fade_time: float
) -> None:
    guard = Guard(amplitude, tick, slew, fade_time)
    angle = amplitude
    for _ in range(math.ceil(amplitude / guard.fade_step) + 1):
        previous, angle = angle, guard.fade(angle)
        assert 0.0 <= angle <= previous
        assert previous - angle <= min(guard.step, guard.fade_step) * (1 + 1e-8)
    assert angle == guard.fade(angle) == 0.0


@given(amplitudes, ticks)
def test_the_default_slew_limit_leaves_a_square_wave_alone(amplitude: float, tick: float) -> None:
    guard = Guard(amplitude, tick, None, fade_time=0.4)
    assert guard.apply(-amplitude, amplitude) == -amplitude
    assert guard.apply(amplitude, -amplitude) == amplitude


@given(angles, angles, st.lists(angles | finite))
def test_a_restricted_guard_permits_neither_more_than_the_servo_reaches_nor_more_than_phi(
    left: float, right: float, commands: list[float]
) -> None:
    lowest, highest = -abs(left), abs(right)
    guard = Guard(0.42, 0.05, None, fade_time=0.4)
    guard.restrict(lowest, highest)
    angle = 0.0
    for command in commands:
        angle = guard.apply(command, angle)
        assert max(-0.42, lowest) <= angle <= min(0.42, highest)


@pytest.mark.parametrize("name", GOOD)
def test_any_finite_real_number_is_an_angle(name: str) -> None:
    guard = Guard(0.42, 0.05, None, 0.4)
    angle = guard.apply(GOOD[name], 0.0)
    assert type(angle) is float
    expected = {"int": 0.0, "int64": 0.0, "beyond": 0.42}.get(name, 0.1)
    assert angle == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", BAD)
def test_a_command_that_is_not_a_finite_real_number_is_refused_with_its_type(name: str) -> None:
    with pytest.raises(
        ValueError, match=r"the instruction angle is (of type \w+, not one real|nan|inf)"
    ):
        Guard(0.42, 0.05, None, 0.4).apply(BAD[name], 0.0)


@pytest.mark.parametrize(("slew_limit", "step"), [("null", 0.84), ("3", 0.15)])
def test_the_loop_keeps_to_the_configured_slew_limit(slew_limit: str, step: float) -> None:
    rig = Rig(f"slew_limit={slew_limit}").start("square", frequency=2)
    angles = [tick.phi_c for tick in rig.run(20)]
    assert max(abs(b - a) for a, b in pairwise(angles)) == pytest.approx(step)
