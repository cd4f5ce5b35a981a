"""Conversion of angles into pulses for all servos: within limits, monotonic, calibrated."""

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import VirtualClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.pulses import MAX_PULSE_US, MIN_PULSE_US, pulse_width, reach
from fishd.hardware.settings import ServoSettings


class Recorder:
    """Driver that records its pulses [µs]."""

    def __init__(self, settings: ServoSettings, neutral: float, clock: Any, **_: Any) -> None:
        self.neutral = neutral
        self.pulses: list[float] = []

    def write(self, pulse: float) -> None:
        self.pulses.append(pulse)


def servo(calibration: ServoCalibration | None = None, centre: float = 1500.0) -> Any:
    settings = ServoSettings(centre=centre)
    applied = calibration or ServoCalibration()
    return CalibratedServo(Recorder, settings, applied, VirtualClock(), threaded=False, tick=0.05)


def raising(error: BaseException) -> Any:
    """Return a servo whose driver raises this error in every method."""

    def fail(*_: float) -> None:
        raise error

    tested_servo = servo()
    tested_servo.driver.write = tested_servo.driver.off = tested_servo.driver.close = fail
    return tested_servo


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ServoError("the board is gone"), "the board is gone"),
        (OSError("device reports readiness"), "OSError: device reports readiness"),
        (SystemExit(3), "SystemExit: 3"),
    ],
)
@pytest.mark.parametrize("method", ["release", "close"])
def test_whatever_keeps_a_driver_from_ending_its_pulses_is_a_servo_error(
    method: str, error: BaseException, message: str
) -> None:
    with pytest.raises(ServoError) as caught:
        getattr(raising(error), method)()
    assert str(caught.value) == message


@pytest.mark.parametrize("method", ["release", "close"])
def test_a_true_ctrl_c_passes(method: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        getattr(raising(KeyboardInterrupt()), method)()


def test_another_calibration_holds_from_the_next_write_on() -> None:
    tested_servo = servo()
    tested_servo.write(0.5)
    tested_servo.recalibrate(ServoCalibration(trim=30, direction=-1, highest=0.3))
    assert (tested_servo.driver.pulses, tested_servo.driver.neutral) == ([1800], 1530)
    tested_servo.write(0.2)
    assert tested_servo.driver.pulses == [1800, 1410]
    assert tested_servo.calibration.direction == -1
    with pytest.raises(ServoError, match="soft limits"):
        tested_servo.write(0.4)


@pytest.mark.parametrize("angle", [math.nan, math.inf, -math.inf, 1.3, -1.3])
def test_an_angle_that_is_not_finite_or_within_limits_never_reaches_a_driver(angle: float) -> None:
    tested_servo = servo()
    with pytest.raises(ServoError, match="soft limits"):
        tested_servo.write(angle)
    tested_servo.write(0.2)
    assert tested_servo.driver.pulses == [1620]


def test_a_calibration_whose_neutral_no_servo_takes_is_refused() -> None:
    too_far = ServoCalibration(trim=300)
    with pytest.raises(ServoError, match="needs a pulse of 2700 µs"):
        servo(too_far, centre=2400.0)
    tested_servo = servo(centre=2400.0)
    with pytest.raises(ServoError, match="2700 µs"):
        tested_servo.recalibrate(too_far)
    assert (tested_servo.calibration, tested_servo.driver.neutral) == (ServoCalibration(), 2400)


servos = st.builds(
    ServoSettings,
    centre=st.floats(500, 2500),
    trim=st.floats(-500, 500),
    direction=st.sampled_from([1, -1]),
    scale=st.floats(10, 5000),
    lowest=st.floats(-math.pi, 0),
    highest=st.floats(0, math.pi),
)
calibrations = st.builds(
    ServoCalibration,
    trim=st.floats(-500, 500),
    direction=st.sampled_from([1, -1]),
    scale=st.floats(10, 5000),
    lowest=st.floats(-3.15, 0),
    highest=st.floats(0, 3.15),
)


@given(servos, st.floats(allow_nan=True, allow_infinity=True))
def test_an_angle_is_a_permitted_pulse_or_refused(servo: ServoSettings, angle: float) -> None:
    try:
        width = pulse_width(servo, angle)
    except ServoError:
        return
    assert 500 <= width <= 2500
    assert servo.lowest - 1e-9 <= angle <= servo.highest + 1e-9


@given(servos, st.floats(0, 1), st.floats(0, 1))
def test_a_larger_angle_turns_further(servo: ServoSettings, share_1: float, share_2: float) -> None:
    lowest, highest = reach(servo)
    if lowest > highest:  # centre and trim permit no pulse
        return
    # Rounding could move the ends beyond 500 or 2500 µs.
    inside = [lowest + (highest - lowest) * (0.001 + 0.998 * share) for share in (share_1, share_2)]
    first, second = sorted(inside)
    change = pulse_width(servo, second) - pulse_width(servo, first)
    assert servo.direction * change == pytest.approx(servo.scale * (second - first), abs=1e-6)
    assert servo.direction * change >= 0


@given(servos)
def test_every_angle_within_reach_is_a_pulse_and_none_beyond(servo: ServoSettings) -> None:
    lowest, highest = reach(servo)
    if lowest > highest:
        with pytest.raises(ServoError):
            pulse_width(servo, 0.0)
        return
    for share in (0.001, 0.5, 0.999):
        angle = lowest + share * (highest - lowest)
        assert MIN_PULSE_US <= pulse_width(servo, angle) <= MAX_PULSE_US
    for beyond in (lowest - 1e-3, highest + 1e-3):
        with pytest.raises(ServoError):
            pulse_width(servo, beyond)


@given(servos, calibrations, st.floats(-3.15, 3.15))
def test_a_calibration_takes_precedence_and_the_settings_own_one_changes_nothing(
    servo: ServoSettings, calibration: ServoCalibration, angle: float
) -> None:
    assert servo.calibrated(servo.calibration) == servo
    result = servo.calibrated(calibration)
    neutral = servo.centre + calibration.trim
    try:
        width = pulse_width(result, angle)
    except ServoError:
        return
    assert calibration.lowest - 1e-9 <= angle <= calibration.highest + 1e-9
    assert width == pytest.approx(neutral + calibration.direction * calibration.scale * angle)
