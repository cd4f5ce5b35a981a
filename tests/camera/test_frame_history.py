"""Which frames a tick is shown, however many there are a second."""

import numpy as np
import pytest

from fishd.camera.frames import Frame, FrameHistory, StackSettings


def frame(time: float, late: float = 0.0) -> Frame:
    return Frame(time, time + late, np.full((1, 1), round(time * 1e3) % 251, np.uint8))


def history(rate: float, seconds: float, late: float, settings: StackSettings) -> FrameHistory:
    found = FrameHistory(settings)
    for number in range(round(rate * seconds)):
        found.add(frame(number / rate, late))
    return found


@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0])
def test_a_stack_is_of_the_newest_frames_before_its_times(rate: float) -> None:
    settings = StackSettings(frames=4, interval=0.05, delay=0.1, oldest=0.06)
    stack = history(rate, 10.0, 0.04, settings).stack(9.9)
    assert stack is not None
    assert stack[:, 0, 0].tolist() == [round(9.8e3 - 50 * k) % 251 for k in range(4)]


def test_a_frame_that_had_not_arrived_by_the_tick_is_not_shown() -> None:
    settings = StackSettings(frames=1, delay=0.0, oldest=1.0)
    stack = history(100.0, 1.0, 0.2, settings).stack(0.5)
    assert stack is not None
    assert stack[0, 0, 0] == 300 % 251


def test_a_gap_is_said() -> None:
    settings = StackSettings(frames=2, interval=0.05, oldest=0.1)
    kept = history(100.0, 1.0, 0.0, settings)
    kept.add(frame(1.5))
    assert kept.stack(1.5) is None


def test_memory_is_bounded() -> None:
    settings = StackSettings(frames=8, interval=1.0, oldest=2.0, delay=1.0)
    assert len(history(1000.0, 20.0, 0.0, settings)._frames) <= 4096
    short = history(1000.0, 20.0, 0.0, StackSettings())
    assert len(short._frames) < 2600
