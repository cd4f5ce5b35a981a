"""The servo through the kernel's PWM: exact pulses on a Pi 5, and wherever there is no pigpiod.

The hardware makes the pulses, so they outlive this process: see `neutralise`.
"""

import math
import os
from contextlib import suppress

from fishd.clock import Clock
from fishd.errors import ServoError
from fishd.hardware import pwm_pulses
from fishd.hardware.calibration import ServoCalibration, calibrated
from fishd.hardware.pulses import pulse_width
from fishd.hardware.pwm_channel import Files, PwmChannel
from fishd.hardware.pwm_pulses import PATIENCE
from fishd.hardware.settings import ServoSettings


class SysfsPwmServo:
    """A servo on one channel of the kernel's PWM."""

    countdown = math.inf

    degraded: tuple[str, ...] = ()

    def __init__(
        self,
        settings: ServoSettings,
        calibration: ServoCalibration,
        clock: Clock,
        files: Files = os,
    ) -> None:
        """Open the channel and leave its pulses as they are, or go on without and keep trying.

        files: where the channel's files are; by default those of this machine
        Raises `ServoError` for a calibration whose neutral is no pulse for a servo.
        """
        self._settings = settings
        self._clock = clock
        self._period = 1.0 / settings.frequency
        self.recalibrate(calibration)
        self._driving = False  # pulses of ours are on
        self._owned = False  # the channel was used: it has to be unexported
        self._closed = False
        self._lost = False
        self._reconnects = 0
        self._channel = PwmChannel(settings, clock, files)
        # Each write and release tries again, and says what is wrong.
        with suppress(ServoError):
            self._channel.open(PATIENCE)

    def recalibrate(self, calibration: ServoCalibration) -> None:
        """Use another calibration from the next write on.

        Raises `ServoError`, and keeps the old one, if its neutral is no pulse for a servo.
        """
        servo = calibrated(self._settings, calibration)
        self._neutral = pulse_width(servo, 0.0)
        self._servo = servo
        self.calibration = calibration

    def counters(self) -> dict[str, int]:
        """How often the channel was opened again since start."""
        return {"servo_reconnects": self._reconnects}

    def write(self, angle: float) -> None:
        """Send an instruction angle [rad], and with it pulses if there were none.

        Raises `ServoError`; after that, each write tries to open the channel again, at once.
        """
        width = pulse_width(self._servo, angle)
        try:
            if self._driving:
                self._check_pulses()
                self._channel.write("duty_cycle", pwm_pulses.nanoseconds(width))
            else:
                self._channel.open(patience=0.0)
                self._begin(width)
        except ServoError:
            self._lose()
            raise

    def release(self) -> None:
        """Stop the pulses once the present one has ended; may be called twice.

        Raises `ServoError` when the channel cannot be reached.
        """
        try:
            self._channel.open(patience=0.0)
            if pwm_pulses.on(self._channel):
                # Not enable 0, which lets the level fall in the middle of a pulse: the servo would
                # jerk. A new duty cycle takes effect when the present period has ended.
                self._channel.write("duty_cycle", 0)
        except ServoError:
            self._lose()
            raise
        self._driving = False

    def close(self) -> None:
        """Release the servo, switch the channel off and unexport it; may be called twice.

        A channel that was already exported and has not been used is left alone, as another process
        may hold it. Raises `ServoError` when that fails; no step is left out because of another.
        """
        if self._closed:
            return
        self._closed = True
        try:
            try:
                self.release()
            finally:
                if self._owned:
                    self._channel.open(patience=0.0)  # a release that fails closes it
                    pwm_pulses.switch_off(self._channel, self._period, self._clock.sleep)
        except ServoError:
            if self._owned:  # else there never were pulses of ours
                raise
        finally:
            self._channel.close()
            if self._owned or self._channel.exported:
                self._channel.unexport()

    def neutralise(self) -> bool:
        """Send a servo that gets pulses to neutral and stop them; False where there are none.

        The last resort when fishd is dead. Should it be alive, its next write fails, because
        its pulses are off. Raises `ServoError` when a step fails; the pulses are stopped all the
        same, if they can be.
        """
        return pwm_pulses.neutralise(self._channel, self._neutral, self._period, self._clock.sleep)

    def _begin(self, width: float) -> None:
        self._owned = True
        pwm_pulses.begin(self._channel, width, self._period)
        self._driving = True
        self._reconnects += self._lost
        self._lost = False

    def _check_pulses(self) -> None:
        """Without this, a servo that somebody else has released would be written to in vain."""
        if not self._channel.read("enable"):
            raise ServoError(
                f"{self._channel.path}: the servo's pulses were switched off from outside, "
                "such as by 'fishctl release'"
            )

    def _lose(self) -> None:
        """Forget a channel that has failed, so that it is opened again."""
        self._driving = False
        self._lost = True
        self._channel.close()
