"""The one map from an angle to a pulse: within limits, monotonic, and nothing that is no number."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.core.calibration import ServoCalibration
from fishd.core.errors import ServoError
from fishd.hardware.servo.pulses import LONGEST, SHORTEST, pulse_width, reach
from fishd.hardware.settings import ServoSettings

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
def test_a_larger_angle_turns_further_in_the_stated_direction(
    servo: ServoSettings, one: float, other: float
) -> None:
    lowest, highest = reach(servo)
    if lowest > highest:  # centre and trim leave no pulse at all
        return
    # Rounding could carry the very ends beyond 500 or 2500 µs.
    inside = [lowest + (highest - lowest) * (0.001 + 0.998 * share) for share in (one, other)]
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
        assert SHORTEST <= pulse_width(servo, lowest + share * (highest - lowest)) <= LONGEST
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


@pytest.mark.parametrize("angle", [math.nan, math.inf, -math.inf])
def test_what_is_no_angle_is_refused_with_the_limits(angle: float) -> None:
    with pytest.raises(ServoError, match=r"soft limits, -1.2 to 1.2 rad"):
        pulse_width(ServoSettings(), angle)


def test_neutral_is_centre_and_trim() -> None:
    assert pulse_width(ServoSettings(centre=1520.0, trim=-15.0), 0.0) == 1505.0


def test_a_pulse_beyond_what_servos_take_is_refused_by_its_width() -> None:
    with pytest.raises(ServoError, match="needs a pulse of 2700 µs, beyond 500 to 2500 µs"):
        pulse_width(ServoSettings(scale=1000.0), 1.2)
