"""Rate of a camera and age of its frames in its state."""

import time
from typing import Any

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


@pytest.mark.parametrize(
    ("options", "silence", "rate", "latency"),
    [
        ({}, 0.0, 25.0, 0.03),
        ({}, 2.1, 0.0, None),
        ({"apart": 4.0}, 5.0, 0.25, 0.03),
        ({"apart": 4.0}, 13.0, 0.0, None),
        ({"virtual": True}, 60.0, 25.0, 0.03),
    ],
    ids=["now", "a silence", "a slow camera", "frames of it are late", "in lockstep time stands"],
)
def test_rate_and_latency_are_those_of_late(
    options: dict[str, Any], silence: float, rate: float, latency: float | None
) -> None:
    clock = Clock()
    monitor = streaming(clock, **options)
    clock.now += silence
    state = monitor.state()
    assert (state.rate, state.latency) == pytest.approx((rate, latency))


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
