"""The one place where an angle becomes a servo pulse."""

from typing import TYPE_CHECKING

from fishd.core.errors import ServoError

if TYPE_CHECKING:  # the last resort has no time to load it
    from fishd.hardware.settings import ServoSettings

SHORTEST, LONGEST = 500.0, 2500.0
"""No servo is sent a pulse outside of this [µs]."""
ROUNDING = 1e-9
"""Angles that differ by less are the same [rad]."""
REST = 0.3
"""Time at neutral before the pulses end, for a servo that did not get there slowly [s]."""


def pulse_width(servo: "ServoSettings", angle: float) -> float:
    """The pulse [µs] for an instruction angle [rad].

    Raises `ServoError` for an angle that is not finite or beyond the soft limits, and for a pulse
    that no servo takes. The guard keeps commands from coming this far.
    """
    if not servo.lowest - ROUNDING <= angle <= servo.highest + ROUNDING:  # NaN is not
        raise ServoError(
            f"the angle {angle:g} rad is not within the servo's soft limits, "
            f"{servo.lowest:g} to {servo.highest:g} rad"
        )
    width = servo.centre + servo.trim + servo.direction * servo.scale * angle
    if not SHORTEST <= width <= LONGEST:
        raise ServoError(
            f"the angle {angle:g} rad needs a pulse of {width:.0f} µs, beyond "
            f"{SHORTEST:.0f} to {LONGEST:.0f} µs"
        )
    return width


def reach(servo: "ServoSettings") -> tuple[float, float]:
    """The lowest and highest angle [rad] that soft limits and pulse widths permit."""
    lowest, highest = widest(servo)
    return max(servo.lowest, lowest), min(servo.highest, highest)


def widest(servo: "ServoSettings") -> tuple[float, float]:
    """The lowest and highest angle [rad] that pulse widths permit."""
    neutral = servo.centre + servo.trim
    ends = ((end - neutral) / (servo.direction * servo.scale) for end in (SHORTEST, LONGEST))
    lowest, highest = sorted(ends)
    return lowest, highest


def cut(servo: "ServoSettings", amplitude: float) -> str:
    """What `reach` leaves of ±Φ, such as `-0.3 to +0.42 rad of ±0.42 rad`; empty for all of it.

    amplitude: Φ [rad]
    """
    lowest, highest = reach(servo)
    if lowest <= -amplitude + ROUNDING and amplitude - ROUNDING <= highest:
        return ""
    left = (max(lowest, -amplitude), min(highest, amplitude))
    return f"{left[0]:+.4g} to {left[1]:+.4g} rad of ±{amplitude:g} rad"
