"""The shortest dwell: what it holds back, what it lets through, and when patience ends."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rigs.harness import LIMITS

from fishd.controllers.base import ChatterSettings, Limits
from fishd.controllers.dwell import DwellLimit
from fishd.core.errors import ControllerFault

PATIENT = ChatterSettings(patience=600.0)


def limited(
    wanted: list[float], dwell: float = 0.2, tick: float = 0.05, limits: Limits = LIMITS
) -> list[float]:
    """Return the limited commands for the angles that a controller wants, from neutral."""
    limit = DwellLimit(dwell, replace(limits, tick=tick), limits.amplitude)
    limit.activate(0.0)
    return [limit.apply(angle, tick) for angle in wanted]


def reversals(angles: list[float]) -> list[int]:
    """The ticks in which a command changes its side of neutral."""
    sided = [(tick, angle > 0.0) for tick, angle in enumerate(angles) if angle]
    return [now for (_, before), (now, after) in pairwise(sided) if before != after]


def test_a_reversal_waits_at_the_angle_of_before_until_the_dwell_is_over() -> None:
    wanted = [0.42, -0.42, -0.4, -0.3, -0.2, -0.1]
    assert limited(wanted) == [0.42, 0.42, 0.42, 0.42, -0.2, -0.1]


@pytest.mark.parametrize(("tick", "ticks"), [(0.005, 40), (0.02, 10), (0.03, 7), (0.2, 1)])
def test_the_dwell_is_a_time_in_whole_ticks_rounded_up(tick: float, ticks: int) -> None:
    limits = replace(LIMITS, chatter=PATIENT)
    angles = limited([0.42] + [-0.42] * 50, tick=tick, limits=limits)
    assert reversals(angles) == [ticks]


@pytest.mark.parametrize(
    ("wanted", "dwell"),
    [
        ([0.42 * (-1) ** (k // 4) * (0.5 + 0.1 * (k % 4)) for k in range(400)], 0.2),
        ([0.42, 0.05, 0.42, 0.0, 0.3, 0.0, 0.42] * 20, 0.2),
        ([0.42 * (-1) ** k for k in range(1000)], 0.0),
    ],
    ids=["slow", "one side", "no dwell"],
)
def test_a_slow_wave_or_no_dwell_changes_nothing(wanted: list[float], dwell: float) -> None:
    assert limited(wanted, dwell) == wanted


def test_who_rests_near_neutral_may_tremble_for_ever_and_the_servo_does_not() -> None:
    angles = limited([0.01 * (-1) ** k for k in range(1000)])
    assert max(map(abs, angles)) == 0.01
    assert min(b - a for a, b in pairwise(reversals(angles))) >= 4


def test_who_wants_to_rest_goes_to_neutral_at_once() -> None:
    assert limited([0.42, -0.01, -0.01]) == [0.42, 0.0, 0.0]


def test_neutral_in_between_does_not_hide_a_reversal() -> None:
    assert reversals(limited([0.42, 0.0, -0.42, 0.0] * 2)) == [6]


def test_a_missed_tick_counts_as_time() -> None:
    limit = DwellLimit(0.2, LIMITS, 0.42)
    assert limit.apply(0.42, 1.0) == 0.42
    limit.activate(0.42)  # starts a new wait
    assert limit.apply(-0.42, 0.15) == 0.42
    assert limit.apply(-0.42, 0.05) == -0.42


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=200),
    st.sampled_from([0.005, 0.02, 0.05, 0.2]),
    st.sampled_from([0.01, 0.1, 0.2, 0.5]),
)
def test_no_reversal_comes_too_soon(wanted: list[float], tick: float, dwell: float) -> None:
    limits = replace(LIMITS, chatter=PATIENT)
    angles = limited(wanted, dwell, tick, limits)
    for before, now in pairwise(reversals(angles)):
        assert (now - before) * tick >= dwell - 1e-3 * tick
    assert all(abs(angle) <= max(map(abs, wanted)) for angle in angles)


@pytest.mark.parametrize("tick", [0.005, 0.05])
@pytest.mark.parametrize("alternating", [False, True])
def test_who_insists_for_two_seconds_loses_command(tick: float, alternating: bool) -> None:
    limits = replace(LIMITS, tick=tick)
    limit = DwellLimit(0.2, limits, 0.3)
    limit.activate(0.3)
    angle, elapsed = 0.3, 0.0

    def swim() -> None:
        nonlocal angle, elapsed
        for k in range(round(10.0 / tick)):
            elapsed += tick
            angle = limit.apply(0.3 * (-1) ** k if alternating else -angle, tick)

    with pytest.raises(ControllerFault, match=r"it wanted to reverse sooner than 0\.2 s") as caught:
        swim()
    assert elapsed == pytest.approx(2.0, abs=1.01 * tick)
    assert caught.value.code == "chatter"
    name, successor = caught.value.successor
    assert (name, successor.parameters.amplitude) == ("swing", 0.3)


def test_who_is_held_back_now_and_then_stays_active() -> None:
    # A half beat of six ticks that is begun again one tick after each reversal.
    beat = [0.42, -0.42, 0.42, 0.42, 0.42, 0.42, -0.42, 0.42, -0.42, -0.42, -0.42, -0.42]
    assert reversals(limited(beat * 100)) == list(range(6, 1200, 6))
