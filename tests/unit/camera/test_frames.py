"""Frames that a tick sees."""

import numpy as np
import pytest

from fishd.core.camera_frames import Frame, FrameHistory, StackSettings


def history_of(*times: float, late: float = 0.0, **settings: float) -> FrameHistory:
    """Return frames of one pixel each, whose level is their number."""
    history = FrameHistory(StackSettings(**settings))
    for number, time in enumerate(times):
        pixels = np.full((1, 1), number % 256, np.uint8)
        history.add(Frame(time, time + late, pixels))
    return history


def levels_at(history: FrameHistory, tick: float) -> list[int] | None:
    stack = history.stack(tick)
    return None if stack is None else [int(frame[0, 0]) for frame in stack]


@pytest.mark.parametrize(
    ("history", "tick", "levels"),
    [
        (history_of(0.0, 0.03, 0.06, 0.1, 0.13, 0.16, 0.2), 0.2, [6, 4, 3, 1]),
        (history_of(*(k * 0.05 + 1e-9 for k in range(5))), 0.2, [4, 3, 2, 1]),
        (history_of(0.0, 0.1, 0.2), 0.2, [2, 1, 1, 0]),
        (history_of(0.0, 0.05, 0.1, 0.15, 0.2, late=0.03), 0.2, [3, 3, 2, 1]),
        (history_of(*(k * 0.025 for k in range(13)), late=0.04, delay=0.05), 0.3, [10, 8, 6, 4]),
    ],
    ids=[
        "a fast camera", "times that differ by rounding alone", "a slow camera, shown twice",
        "a frame that has not arrived yet", "a late camera and a delay, evenly spaced",
    ],
)  # fmt: skip
def test_a_tick_is_shown_the_newest_frame_at_or_before_each_of_its_times(
    history: FrameHistory, tick: float, levels: list[int]
) -> None:
    assert levels_at(history, tick) == levels


@pytest.mark.parametrize("missing", [0, 1, 2, 3])
def test_nothing_is_shown_where_a_frame_is_missing_for_too_long(missing: int) -> None:
    times = [k * 0.05 for k in range(20)]
    newest = len(times) - 1 - missing
    del times[newest - 3 : newest + 1]
    assert levels_at(history_of(*times), 0.95) is None


def test_frames_that_no_tick_can_want_any_more_are_forgotten() -> None:
    history = history_of(*(k * 1e-3 for k in range(20_000)))
    assert levels_at(history, 19.99) is not None
    assert levels_at(history, 15.0) is None
