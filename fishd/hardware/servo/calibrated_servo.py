"""Servo as the loop drives it: it converts angles into pulses with the newest calibration."""

from collections.abc import Callable
from typing import Any

from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import Clock
from fishd.core.errors import ServoError
from fishd.core.foreign_code import call_foreign
from fishd.hardware.driver import ServoDriver
from fishd.hardware.servo import pulses
from fishd.hardware.settings import ServoSettings


class CalibratedServo:
    """Servo whose pulses can be calibrated; may be called from any thread."""

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

        kind: class of the driver, or a function that makes a driver from the same arguments
        Raises what the driver raises, and `ServoError` for a calibration whose neutral is not a
        valid pulse.
        """
        self.calibration = calibration
        self._settings = settings.calibrated(calibration)
        neutral = pulses.pulse_width(self._settings, 0.0)
        self.driver = kind(settings, neutral, clock, tick=tick, threaded=threaded)
        """Driver that sends the pulses."""

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest angle [rad] that soft limits and pulse widths permit."""
        return pulses.reach(self._settings)

    def format_reach(self, amplitude: float) -> str | None:
        """Return the part of ±Φ [rad] within `reach` as a text; None if it is all of ±Φ."""
        return pulses.format_reach(self._settings, amplitude)

    def recalibrate(self, calibration: ServoCalibration) -> None:
        """Use another calibration from the next write on.

        Raises `ServoError`, and keeps the old calibration, if the new neutral is not a valid pulse.
        """
        settings = self._settings.calibrated(calibration)
        self.driver.neutral = pulses.pulse_width(settings, 0.0)
        self._settings = settings
        self.calibration = calibration

    def write(self, instruction_angle: float) -> None:
        """Send an instruction angle [rad]; start the pulses if there are none.

        Raises `ServoError` when the servo cannot be reached, and for an angle beyond its limits.
        """
        call_foreign(self.driver.write, pulses.pulse_width(self._settings, instruction_angle))

    def release(self) -> None:
        """Stop the pulses; may be called twice. Raises `ServoError`."""
        _end_pulses(self.driver.off)

    def close(self) -> None:
        """Release the servo and close the driver; may be called twice. Raises `ServoError`."""
        _end_pulses(self.driver.close)


def _end_pulses(end: Callable[[], None]) -> None:
    """Call a function that ends the pulses; turn every exception of it into a `ServoError`."""
    try:
        call_foreign(end)
    except ServoError:
        raise
    except Exception as error:
        raise ServoError(text.describe_error(error)) from error
