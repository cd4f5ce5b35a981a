"""What every servo does with angles and calibrations before its driver hears of a pulse."""

import math
from typing import Any

import pytest

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import VirtualClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.settings import ServoSettings


class Recorder:
    """A driver that keeps the pulses that it is told [µs]."""

    def __init__(self, settings: ServoSettings, neutral: float, clock: Any, **_: Any) -> None:
        self.neutral = neutral
        self.pulses: list[float] = []

    def write(self, pulse: float) -> None:
        self.pulses.append(pulse)


def servo(calibration: ServoCalibration | None = None, centre: float = 1500.0) -> Any:
    settings = ServoSettings(centre=centre)
    given = calibration or ServoCalibration()
    return CalibratedServo(Recorder, settings, given, VirtualClock(), threaded=False, tick=0.05)


def test_trim_direction_and_scale_come_from_the_calibration() -> None:
    made = servo(ServoCalibration(trim=20, direction=-1, scale=500))
    made.write(0.2)
    assert (made.driver.pulses, made.driver.neutral) == ([1420], 1520)


def test_another_calibration_holds_from_the_next_write_on() -> None:
    made = servo()
    made.write(0.5)
    made.recalibrate(ServoCalibration(trim=30, direction=-1, highest=0.3))
    assert (made.driver.pulses, made.driver.neutral) == ([1800], 1530)
    made.write(0.2)
    assert made.driver.pulses == [1800, 1410]
    assert made.calibration.direction == -1
    with pytest.raises(ServoError, match="soft limits"):
        made.write(0.4)


@pytest.mark.parametrize("angle", [math.nan, math.inf, -math.inf, 1.3, -1.3])
def test_an_angle_that_is_not_finite_or_out_of_limits_never_reaches_the_driver(
    angle: float,
) -> None:
    made = servo()
    with pytest.raises(ServoError, match="soft limits"):
        made.write(angle)
    made.write(0.2)
    assert made.driver.pulses == [1620]


def test_a_calibration_whose_neutral_no_servo_takes_is_refused() -> None:
    too_far = ServoCalibration(trim=300)
    with pytest.raises(ServoError, match="needs a pulse of 2700 µs"):
        servo(too_far, centre=2400.0)
    made = servo(centre=2400.0)
    with pytest.raises(ServoError, match="2700 µs"):
        made.recalibrate(too_far)
    assert (made.calibration, made.driver.neutral) == (ServoCalibration(), 2400)
