"""Servo on software PWM of RPi.GPIO or rpi-lgpio: a last resort, because its pulses jitter."""

from contextlib import suppress
from typing import Annotated, Any

from fishd.core.errors import ServoError
from fishd.core.schema import note, unit
from fishd.hardware import header
from fishd.hardware.driver import Claim, LastResort, ServoDriver, pin
from fishd.hardware.settings import Gpio, ServoSettings


class RpiGpioSettings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pin of the header that drives the servo."""

    gpio: Annotated[Gpio, note("Pin of the servo's signal, Broadcom number.")] = 18
    frequency: Annotated[
        float, unit("Hz", "Pulses per second; more than 50 for digital servos only.", ge=40, le=333)
    ] = 50.0


class RpiGpio(ServoDriver[RpiGpioSettings]):
    """A servo on any pin of the header."""

    Settings = RpiGpioSettings
    packages = (header.PACKAGE,)
    limitations = (
        "software PWM: pulses jitter by tens to hundreds of µs; use pigpio or sysfs-pwm",
    )

    def open(self) -> None:
        """Claim the pin, or continue without it and try again in each write.

        Raises `StartupError` if the library cannot be used.
        """
        self._pwm: Any = None
        self._started = False
        self._usable = False
        self._opened = 0
        self._closed = False
        self._gpio = header.load()
        with suppress(ServoError):  # each write raises it again
            self._open()

    def counters(self) -> dict[str, int]:
        """Return the number of times that the pin was claimed again since start."""
        return {"servo_reconnects": max(0, self._opened - 1)}

    def write(self, pulse: float) -> None:
        """Send a pulse [µs]; start the pulses if there are none.

        Raises `ServoError`; after that, each write tries to claim the pin again.
        """
        if not self._usable:
            self._open()
        self._send(1e-4 * pulse * self.settings.frequency)

    def off(self) -> None:
        """Stop the pulses at the end of the present one; may be called twice.

        Raises `ServoError` when the pin cannot be driven.
        """
        if self._started:
            self._send(0.0)

    def close(self) -> None:
        """End the pulses and make the pin an input; may be called twice.

        Raises `ServoError` when the pulses cannot be stopped; the pin is released nevertheless.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if self._started:
                self._send(0.0)
                self.clock.sleep(1.0 / self.settings.frequency)  # lets the last pulse end
        finally:
            self._release_pin()

    @classmethod
    def claims(cls, settings: RpiGpioSettings) -> tuple[Claim, ...]:
        """Return the claim of the pin."""
        return (pin(settings.gpio, "servo"),)

    @classmethod
    def last_resort(cls, settings: RpiGpioSettings) -> LastResort:
        """Return how to set the pin low: the pulses end with the process, but it may be high."""
        return LastResort(f"{__name__}:pull_low", {"gpio": settings.gpio})

    def _open(self) -> None:
        gpio = self.settings.gpio
        try:
            # Set it each time: another part of the program may have called GPIO.cleanup().
            self._gpio.setmode(self._gpio.BCM)
            header.claim(self._gpio, gpio, self._gpio.OUT, initial=self._gpio.LOW)
            # A failed PWM must be deleted first, as a pin takes only one, and not earlier: its
            # destructor writes to the pin.
            self._pwm = None
            self._pwm = self._gpio.PWM(gpio, self.settings.frequency)
        except Exception as error:
            raise self._failure(error) from None
        self._started = False
        self._usable = True
        self._opened += 1

    def _send(self, duty_cycle: float) -> None:
        """Send pulses with this duty cycle [%].

        A started PWM is never stopped: RPi.GPIO restarts a stopped PWM at 1 kHz, whatever its
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
        return ServoError(f"servo on GPIO {self.settings.gpio}: {header.format_error(error)}")

    def _release_pin(self) -> None:
        """Release this pin only: cleanup() without an argument releases all pins."""
        try:
            try:
                if self._pwm is not None:
                    self._pwm.stop()
            finally:
                self._pwm = None  # while it may still write to the pin
                self._gpio.cleanup(self.settings.gpio)
        except Exception as error:
            raise self._failure(error) from None


def pull_low(neutral: float, *, gpio: int) -> bool:
    """Set the pin low, which a killed process may have left high; always return False.

    Software PWM ends with its process, so no servo has to move to neutral. Raises `ServoError`,
    for example when rpi-lgpio reports that another process holds the pin.
    """
    module = header.load()
    try:
        header.claim(module, gpio, module.OUT, initial=module.LOW)
        module.output(gpio, module.LOW)
    except Exception as error:  # lgpio.error is a bare Exception
        raise ServoError(f"servo on GPIO {gpio}: {header.format_error(error)}") from None
    return False
