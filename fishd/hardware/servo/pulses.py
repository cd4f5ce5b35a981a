"""Conversion of an angle into a servo pulse; no other module converts angles."""

from typing import TYPE_CHECKING

from fishd.core.errors import ServoError

if TYPE_CHECKING:  # `fishd-release` has no time to load it
    from fishd.hardware.settings import ServoSettings

MIN_PULSE_US, MAX_PULSE_US = 500.0, 2500.0
"""Shortest and longest pulse that any servo is sent [µs]."""
ANGLE_TOLERANCE_RAD = 1e-9
"""Largest difference of two angles that count as the same [rad]."""
NEUTRAL_TIME_S = 0.3
"""Time at neutral before the pulses end, for a servo that did not get there slowly [s]."""


def pulse_width(servo: "ServoSettings", instruction_angle: float) -> float:
    """Return the pulse [µs] for an instruction angle [rad].

    Raises `ServoError` for an angle that is not finite or beyond the soft limits, and for a pulse
    that no servo accepts. The guard limits commands before they get here.
    """
    # NaN is refused too.
    if (
        not servo.lowest - ANGLE_TOLERANCE_RAD
        <= instruction_angle
        <= servo.highest + ANGLE_TOLERANCE_RAD
    ):
        raise ServoError(
            f"the angle {instruction_angle:g} rad is not within the servo's soft limits, "
            f"{servo.lowest:g} to {servo.highest:g} rad"
        )
    width = servo.centre + servo.trim + servo.direction * servo.scale * instruction_angle
    if not MIN_PULSE_US <= width <= MAX_PULSE_US:
        raise ServoError(
            f"the angle {instruction_angle:g} rad needs a pulse of {width:.0f} µs, beyond "
            f"{MIN_PULSE_US:.0f} to {MAX_PULSE_US:.0f} µs"
        )
    return width


def reach(servo: "ServoSettings") -> tuple[float, float]:
    """Return the lowest and highest angle [rad] that soft limits and pulse widths permit."""
    lowest, highest = pulse_reach(servo)
    return max(servo.lowest, lowest), min(servo.highest, highest)


def pulse_reach(servo: "ServoSettings") -> tuple[float, float]:
    """Return the lowest and highest angle [rad] that pulse widths permit."""
    neutral = servo.centre + servo.trim
    ends = (
        (end - neutral) / (servo.direction * servo.scale) for end in (MIN_PULSE_US, MAX_PULSE_US)
    )
    lowest, highest = sorted(ends)
    return lowest, highest


def format_reach(servo: "ServoSettings", amplitude: float) -> str | None:
    """Return the part of ±Φ within `reach` as a text; None if it is all of ±Φ.

    amplitude: Φ [rad]
    An example of the text is `-0.3 to +0.42 rad of ±0.42 rad`.
    """
    lowest, highest = reach(servo)
    if lowest <= -amplitude + ANGLE_TOLERANCE_RAD and amplitude - ANGLE_TOLERANCE_RAD <= highest:
        return None
    part = (max(lowest, -amplitude), min(highest, amplitude))
    return f"{part[0]:+.4g} to {part[1]:+.4g} rad of ±{amplitude:g} rad"
