"""The one place where an angle becomes a servo pulse."""

from fishd.errors import ServoError
from fishd.hardware.settings import ServoSettings

SHORTEST, LONGEST = 500.0, 2500.0
"""No servo is sent a pulse outside of this [µs]."""
REST = 0.3
"""Time at neutral before the pulses end, for a servo that did not get there slowly [s]."""


def pulse_width(servo: ServoSettings, angle: float) -> float:
    """The pulse [µs] for an instruction angle [rad].

    Raises `ServoError` for an angle that is not finite or beyond the soft limits, and for a pulse
    that no servo takes. The guard keeps commands from coming this far.
    """
    if not servo.lowest - 1e-9 <= angle <= servo.highest + 1e-9:  # NaN is not
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


def reach(servo: ServoSettings) -> tuple[float, float]:
    """The lowest and highest angle [rad] that soft limits and pulse widths permit."""
    neutral = servo.centre + servo.trim
    ends = sorted((end - neutral) / (servo.direction * servo.scale) for end in (SHORTEST, LONGEST))
    return max(servo.lowest, ends[0]), min(servo.highest, ends[1])
