"""Rate of a camera and age of its frames in its state."""

import time

import pytest

from fishd.camera.monitor import Monitor
from fishd.camera.settings import CameraSettings
from fishd.camera.sources.base import Timeline


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def streaming(clock: Clock, *, apart: float = 0.04, virtual: bool = False) -> Monitor:
    """Return a monitor after ten frames, each 30 ms after its exposure."""
    monitor = Monitor(CameraSettings(), "a camera", "ipc://frames", clock)
    monitor.begin("one", Timeline(virtual, "", None), ())
    for _ in range(10):
        clock.now += apart
        monitor.frame(clock.now - 0.03, clock.now, None, (480, 640))
    return monitor


def test_rate_and_latency_are_those_of_late() -> None:
    state = streaming(Clock()).state()
    assert state.rate == pytest.approx(25.0)
    assert state.latency == pytest.approx(0.03)


def test_where_no_frame_has_come_for_a_while_there_is_neither_rate_nor_latency() -> None:
    clock = Clock()
    monitor = streaming(clock)
    clock.now += 2.1
    assert (monitor.state().rate, monitor.state().latency) == (0.0, None)


def test_the_rate_of_a_slow_camera_lasts_until_frames_are_late() -> None:
    clock = Clock()
    monitor = streaming(clock, apart=4.0)
    clock.now += 5.0
    assert monitor.state().rate == pytest.approx(0.25)
    clock.now += 8.0
    assert monitor.state().rate == 0.0


def test_in_lockstep_nothing_grows_old_while_time_stands_still() -> None:
    clock = Clock()
    monitor = streaming(clock, virtual=True)
    clock.now += 60.0
    assert monitor.state().rate == pytest.approx(25.0)


def test_the_age_of_a_condition_does_not_follow_the_unix_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock()
    monitor = streaming(clock)
    before = time.time()
    clock.now += 5.0
    monkeypatch.setattr("time.time", lambda: before - 3600.0)
    state = monitor.state()
    assert state.t - state.since == pytest.approx(5.36)
