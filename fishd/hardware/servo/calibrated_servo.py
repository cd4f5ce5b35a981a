"""The servo as the loop drives it: angles in, a driver's pulses out, by the newest calibration."""

from collections.abc import Callable
from typing import Any

from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import Clock
from fishd.core.errors import ServoError
from fishd.core.foreign_code import contained
from fishd.hardware.driver import ServoDriver
from fishd.hardware.servo import pulses
from fishd.hardware.settings import ServoSettings


class CalibratedServo:
    """A servo whose pulses can be calibrated; may be called from any thread."""

    def __init__(
        self,
        kind: Callable[..., ServoDriver[Any]],
        settings: ServoSettings,
        calibration: ServoCalibration,
        clock: Clock,
        *,
        threaded: bool,
        tick: float,
    ) -> None:
        """Open the driver.

        kind: its class, or what else makes one from the same arguments
        Raises what the driver raises, and `ServoError` for a calibration whose neutral is no pulse
        for a servo.
        """
        self.calibration = calibration
        self._settings = settings.calibrated(calibration)
        neutral = pulses.pulse_width(self._settings, 0.0)
        self.driver = kind(settings, neutral, clock, tick=tick, threaded=threaded)
        """What sends the pulses."""

    @property
    def reach(self) -> tuple[float, float]:
        """The lowest and highest angle [rad] that soft limits and pulse widths permit."""
        return pulses.reach(self._settings)

    def cut(self, amplitude: float) -> str:
        """What `reach` leaves of ±Φ [rad], in words; empty for all of it."""
        return pulses.cut(self._settings, amplitude)

    def recalibrate(self, calibration: ServoCalibration) -> None:
        """Use another calibration from the next write on.

        Raises `ServoError`, and keeps the old one, if its neutral is no pulse for a servo.
        """
        settings = self._settings.calibrated(calibration)
        self.driver.neutral = pulses.pulse_width(settings, 0.0)
        self._settings = settings
        self.calibration = calibration

    def write(self, angle: float) -> None:
        """Send an instruction angle [rad], and with it pulses if there were none.

        Raises `ServoError` when the servo cannot be reached, and for an angle that it must not get.
        """
        contained(self.driver.write, pulses.pulse_width(self._settings, angle))

    def release(self) -> None:
        """Stop the pulses; may be called twice. Raises `ServoError`."""
        _ended(self.driver.off)

    def close(self) -> None:
        """Release the servo and let go of it; may be called twice. Raises `ServoError`."""
        _ended(self.driver.close)


def _ended(end: Callable[[], None]) -> None:
    """Call what ends the pulses; whatever it raises, they may still be on: a `ServoError`."""
    try:
        contained(end)
    except ServoError:
        raise
    except Exception as error:
        raise ServoError(text.named(error)) from error
