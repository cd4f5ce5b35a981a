"""Clock of a video against that of a recording, from the fin angle and the forces."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from rigs import filmed_swim
from rigs.filmed_swim import felt
from scipy.interpolate import CubicSpline

from fishd.lab.video_clock import NoOffset, find_offset

Array = NDArray[np.float64]
swum = cache(filmed_swim.swum)  # ticks are immutable


def seen(
    seconds: float, begin: float, end: float, controller: str = "excitation", stretch: float = 0.0
) -> tuple[Array, Array]:
    """Return times and fin angles of a video from one time of a swim to another, with its flaws."""
    ticks = swum(seconds, controller=controller)
    at = [tick.time for tick in ticks]
    spline = CubicSpline(at, [tick.alpha for tick in ticks])
    times = np.arange(0.0, end - begin, 1 / 30)
    true = begin + (1.0 + stretch) * times
    noise = np.random.default_rng(1)
    angles = np.where((true > at[0]) & (true < at[-1]), spline(true), 0.0)
    angles += 0.003 * noise.standard_normal(len(times))
    angles[noise.uniform(size=len(times)) < 0.05] = np.nan
    return times, angles


@pytest.mark.parametrize(
    ("begin", "end", "stretch"),
    [(20.0, 40.0, 0.0), (-20.0, 20.0, 0.0), (-10.0, 70.0, 0.0), (20.0, 50.0, 1e-3)],
    ids=["within the recording", "begins before it", "around it", "a slow clock"],
)
def test_offset_and_pace_are_found_wherever_the_video_begins(
    begin: float, end: float, stretch: float
) -> None:
    clock = find_offset(*seen(60.0, begin, end, stretch=stretch), felt(swum(60.0)))
    assert clock.offset == pytest.approx(begin + stretch * clock.at, abs=2e-3)
    assert clock.ci95 < 2e-3
    assert clock.stretch == pytest.approx(stretch, abs=1e-4)
    assert clock.begin[0] == pytest.approx(begin, abs=4e-3)
    assert clock.to_recording(np.array([clock.at])) == pytest.approx(clock.at + clock.offset)


@pytest.mark.parametrize(
    ("begin", "end", "controller", "message"),
    [
        (100.0, 130.0, "excitation", r"agree by \d+% only: .* does it overlap with the video\?"),
        (10.0, 13.0, "excitation", r"^3.0 s are too short to compare the clocks"),
        (20.0, 40.0, "swing", r"^the recording may begin .* because the swim repeats itself"),
    ],
    ids=["apart", "short", "a steady beat"],
)
def test_an_offset_that_is_not_known_is_not_given(
    begin: float, end: float, controller: str, message: str
) -> None:
    forces = felt(swum(60.0, controller=controller))
    times, angles = seen(60.0, begin, end, controller)
    if begin > 60.0:
        angles = 0.3 * np.sin(5.0 * times + 2.0 * np.sin(0.7 * times))
    with pytest.raises(NoOffset, match=message):
        find_offset(times, angles, forces)


def test_a_recording_without_forces_is_named() -> None:
    forces = [force._replace(fy=0.0) for force in felt(swum(60.0))]
    with pytest.raises(NoOffset, match="the recording has no lateral forces"):
        find_offset(*seen(60.0, 20.0, 40.0), forces)
