"""The servo on software PWM of RPi.GPIO or rpi-lgpio: a last resort, whose pulses jitter."""

import math
from contextlib import suppress
from typing import Any

from fishd.clock import Clock
from fishd.errors import ServoError
from fishd.hardware import header
from fishd.hardware.calibration import ServoCalibration, calibrated
from fishd.hardware.pulses import pulse_width
from fishd.hardware.settings import ServoSettings


class RpiGpioServo:
    """A servo on any pin of the header."""

    countdown = math.inf

    degraded: tuple[str, ...] = (
        "software PWM: pulses jitter by tens to hundreds of µs; use pigpio or sysfs-pwm",
    )

    def __init__(
        self, settings: ServoSettings, calibration: ServoCalibration, clock: Clock
    ) -> None:
        """Claim the pin, or go on without and try again in each write.

        Raises `StartupError` where the library cannot be used, and `ServoError` for a calibration
        whose neutral is no pulse for a servo.
        """
        self._settings = settings
        self._clock = clock
        self._pwm: Any = None
        self._started = False
        self._usable = False
        self._opened = 0
        self._closed = False
        self.recalibrate(calibration)
        self._gpio = header.load()
        with suppress(ServoError):  # each write says so
            self._open()

    def recalibrate(self, calibration: ServoCalibration) -> None:
        """Use another calibration from the next write on.

        Raises `ServoError`, and keeps the old one, if its neutral is no pulse for a servo.
        """
        servo = calibrated(self._settings, calibration)
        pulse_width(servo, 0.0)
        self._servo = servo
        self.calibration = calibration

    def counters(self) -> dict[str, int]:
        """How often the pin was claimed again since start."""
        return {"servo_reconnects": max(0, self._opened - 1)}

    def write(self, angle: float) -> None:
        """Send an instruction angle [rad], and with it pulses if there were none.

        Raises `ServoError`; after that, each write tries to claim the pin again.
        """
        width = pulse_width(self._servo, angle)
        if not self._usable:
            self._open()
        self._send(1e-4 * width * self._settings.frequency)

    def release(self) -> None:
        """Stop the pulses once the present one has ended; may be called twice.

        Raises `ServoError` when the pin cannot be driven.
        """
        if self._started:
            self._send(0.0)

    def close(self) -> None:
        """Release the servo and make its pin an input; may be called twice.

        Raises `ServoError` when the pulses cannot be stopped; the pin is given back all the same.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._started:
                self._send(0.0)
                self._clock.sleep(1.0 / self._settings.frequency)  # lets the last pulse end
        finally:
            self._give_back()

    def neutralise(self) -> bool:
        """Leave the pin low, where a killed process may have left it high; always False.

        Software PWM ends with its process, so there is nothing to move to neutral. Raises
        `ServoError`, as when rpi-lgpio says that another process holds the pin.
        """
        if not self._usable:
            self._open()
        try:
            self._gpio.output(self._settings.gpio, self._gpio.LOW)
        except Exception as error:
            raise self._failure(error) from None
        return False

    def _open(self) -> None:
        gpio = self._settings.gpio
        try:
            # Again each time: another part of the program may have called GPIO.cleanup().
            self._gpio.setmode(self._gpio.BCM)
            header.claim(self._gpio, gpio, self._gpio.OUT, initial=self._gpio.LOW)
            # One that failed must go first, as a pin takes only one, and only now: it writes to
            # the pin when it goes.
            self._pwm = None
            self._pwm = self._gpio.PWM(gpio, self._settings.frequency)
        except Exception as error:
            raise self._failure(error) from None
        self._started = False
        self._usable = True
        self._opened += 1

    def _send(self, duty_cycle: float) -> None:
        """Pulses of so many percent.

        Once started, it is never stopped: RPi.GPIO restarts a stopped PWM at 1 kHz, whatever its
        frequency was, while its old thread still writes to the pin.
        """
        try:
            if self._started:
                self._pwm.ChangeDutyCycle(duty_cycle)
            else:
                self._pwm.start(duty_cycle)
                self._started = True
        except Exception as error:  # lgpio.error is a bare Exception
            raise self._failure(error) from None

    def _failure(self, error: Exception) -> ServoError:
        self._usable = False
        return ServoError(f"servo on GPIO {self._settings.gpio}: {header.one_line(error)}")

    def _give_back(self) -> None:
        """Only the own pin: cleanup() without one takes those of everybody."""
        try:
            try:
                if self._pwm is not None:
                    self._pwm.stop()
            finally:
                self._pwm = None  # while it may still write to the pin
                self._gpio.cleanup(self._settings.gpio)
        except Exception as error:
            raise self._failure(error) from None
