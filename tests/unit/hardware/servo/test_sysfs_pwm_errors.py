"""Servo on the kernel's PWM when single writes and reads fail: the other steps are done."""

from typing import Any

import pytest
from rigs.sysfs_pwm_rig import PI5, Bench

from fishd.core.errors import ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo

NEUTRAL = 1_500_000


@pytest.fixture
def bench() -> Bench:
    return Bench({PI5: 4})


@pytest.fixture(autouse=True)
def servo(bench: Bench) -> CalibratedServo:
    """Return the servo of a fishd that is swimming when a file breaks."""
    servo = bench.servo()
    assert bench.write(servo, 0.5) == 1800.0
    return servo


def settled_width(bench: Bench) -> float:
    """Wait two periods; return the pulse then [µs]."""
    bench.clock.sleep(0.04)
    return bench.width()


@pytest.mark.parametrize(
    "unwritable",
    [{("duty_cycle", NEUTRAL)}, {("duty_cycle", NEUTRAL), ("duty_cycle", 0)}, {("enable", 0)}],
)
def test_the_last_resort_ends_all_pulses(bench: Bench, unwritable: set[tuple[str, int]]) -> None:
    bench.kernel.unwritable = unwritable
    with pytest.raises(ServoError, match="Input/output error"):
        bench.last_resort()
    assert settled_width(bench) == 0.0


def test_the_last_resort_stops_the_pulses_though_the_user_is_impatient(bench: Bench) -> None:
    sleep = bench.clock.sleep

    def interrupt(seconds: float) -> None:
        bench.clock.sleep = sleep  # type: ignore[method-assign]
        raise KeyboardInterrupt

    bench.clock.sleep = interrupt  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        bench.last_resort()
    assert settled_width(bench) == 0.0


@pytest.mark.parametrize(
    ("what", "broken"),
    [("unreadable", "duty_cycle"), ("unreadable", "enable"), ("unwritable", ("duty_cycle", 0))],
    ids=str,
)
def test_close_ends_a_channel_that_cannot_be_released(
    bench: Bench, servo: CalibratedServo, what: str, broken: Any
) -> None:
    getattr(bench.kernel, what).add(broken)
    with pytest.raises(ServoError, match="Input/output error"):
        servo.close()
    channel = bench.kernel._chips[PI5][2]
    assert channel.state.enable == 0
    assert settled_width(bench) == 0.0
    assert channel.exported_at is None
