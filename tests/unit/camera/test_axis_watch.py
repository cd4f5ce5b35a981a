"""Estimate of the axis while frames arrive."""

from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace
from rigs import filmed_swim
from rigs.filmed_swim import filmed
from rigs.pictures import WEB

from fishd.camera.axis import SEARCH_PERIOD_S, AxisWatch
from fishd.camera.simulated import DEFAULT
from fishd.core.camera_frames import Frame

swum = cache(filmed_swim.swum)  # ticks are immutable
CAMERA = replace(DEFAULT, off_axis=3.0, tilt=0.05)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def count_searches(watch: AxisWatch, clock: Clock, frames: list[Frame]) -> int:
    """Return the number of searches for the axis."""
    looked = 0
    for frame in frames:
        clock.now = frame.time
        watch.add(frame)
        if watch.due:
            watch.find()
            looked += 1
    return looked


def test_it_is_found_once_the_tail_has_moved_for_some_seconds_and_kept_while_it_rests() -> None:
    clock = Clock()
    watch = AxisWatch(clock)
    swims = filmed(swum(12.0, controller="swing"), CAMERA)
    looked = count_searches(watch, clock, swims)
    assert 2 <= looked <= 12.0 / SEARCH_PERIOD_S
    assert watch.moving
    assert watch.axis.offset == pytest.approx(3.0, abs=0.2)
    assert watch.axis.tilt == pytest.approx(0.05, abs=0.01)
    first_axis = watch.axis
    rests = filmed(swum(40.0, controller="hold"), CAMERA)
    count_searches(watch, clock, [frame._replace(time=frame.time + 12.0) for frame in rests])
    assert not watch.moving
    assert watch.axis.offset == pytest.approx(first_axis.offset, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [30.0, 60.0])
def test_a_rate_that_goes_with_the_beat_does_no_harm(rate: float) -> None:
    clock = Clock()
    watch = AxisWatch(clock)
    camera = replace(WEB, off_axis=3.0, tilt=0.05, rate=rate)
    count_searches(watch, clock, filmed(swum(20.0, controller="swing"), camera))
    assert watch.axis.offset == pytest.approx(3.0, abs=0.15)
    assert watch.axis.tilt == pytest.approx(0.05, abs=0.006)


def test_of_a_fast_camera_some_20_frames_a_second_are_kept() -> None:
    clock = Clock()
    watch = AxisWatch(clock)
    frames = [Frame(0.001 * k, 0.001 * k, np.zeros((16, 16), np.uint8)) for k in range(1000)]
    count_searches(watch, clock, frames)
    assert not watch.due
    assert len(watch) < 25


def test_frames_of_another_size_begin_anew() -> None:
    clock = Clock()
    watch = AxisWatch(clock)
    count_searches(watch, clock, filmed(swum(12.0, controller="swing"), CAMERA))
    watch.add(Frame(13.0, 13.0, np.zeros((32, 32), np.uint8)))
    assert watch.axis is None
    assert len(watch) == 1
