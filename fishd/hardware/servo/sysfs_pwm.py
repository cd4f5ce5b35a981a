"""Servo through the kernel's PWM: exact pulses on a Pi 5, or on any Pi without pigpiod.

The hardware makes the pulses, so they outlive this process: see `last_resort`.
"""

import os
from contextlib import suppress
from typing import Annotated, Any

from msgspec import Meta

from fishd.core.clock import SystemClock
from fishd.core.errors import ServoError
from fishd.core.schema import note, unit
from fishd.hardware.checks import Check, Machine, Result, fail, ok, warning
from fishd.hardware.driver import Claim, LastResort, ServoDriver, pin
from fishd.hardware.servo.pwm_pulses import UDEV_TIMEOUT_S, PwmChannel, Wires
from fishd.hardware.settings import Gpio, ServoSettings


class SysfsPwmSettings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Channel of the kernel's PWM that drives the servo."""

    gpio: Annotated[Gpio, note("Pin of the servo's signal, Broadcom number.")] = 18
    frequency: Annotated[
        float, unit("Hz", "Pulses per second; more than 50 for digital servos only.", ge=40, le=333)
    ] = 50.0
    root: Annotated[str, note("Folder of the PWM chips.")] = "/sys/class/pwm"
    chip: Annotated[
        str | None,
        note("Device of the chip, such as 1f00098000.pwm; null for that of the Pi's header."),
    ] = None
    channel: Annotated[
        Annotated[int, Meta(ge=0, le=15)] | None,
        note("Channel of the chip; null for the one that servo.gpio is wired to."),
    ] = None

    @property
    def pulse_period(self) -> float:
        """Period of the pulses [s]."""
        return 1.0 / self.frequency

    @property
    def wires(self) -> Wires:
        """Pin, chip and channel of the servo."""
        return Wires(self.gpio, self.root, self.chip, self.channel)


class SysfsPwm(ServoDriver[SysfsPwmSettings]):
    """A servo on one channel of the kernel's PWM."""

    Settings = SysfsPwmSettings

    def __init__(self, *given: Any, files: Any = os, **named: Any) -> None:
        """Do as `ServoDriver`.

        files: functions that access the channel's files, by default those of this machine
        """
        self._files = files
        super().__init__(*given, **named)

    def open(self) -> None:
        """Open the channel without changing its pulses, or continue without it and keep trying."""
        self._period = 1.0 / self.settings.frequency
        self._driving = False  # whether pulses of this object are on
        self._is_used = False  # whether the channel was used, and has to be unexported
        self._closed = False
        self._lost = False
        self._reconnects = 0
        self._channel = PwmChannel(self.settings.wires, self.clock, self._files)
        # Each `write` and `off` tries again, and raises the error.
        with suppress(ServoError):
            self._channel.open(UDEV_TIMEOUT_S)

    def counters(self) -> dict[str, int]:
        """Return the number of times that the channel was opened again since start."""
        return {"servo_reconnects": self._reconnects}

    def write(self, pulse: float) -> None:
        """Send a pulse [µs]; start the pulses if there are none.

        Raises `ServoError`; after that, each write tries to open the channel again, at once.
        """
        try:
            if self._driving:
                self._check_pulses()
                self._channel.change_pulses(pulse)
            else:
                self._channel.open(timeout=0.0)
                self._begin(pulse)
        except ServoError:
            self._lose()
            raise

    def off(self) -> None:
        """Stop the pulses at the end of the present one; may be called twice.

        Raises `ServoError` when the channel cannot be reached.
        """
        try:
            self._channel.open(timeout=0.0)
            if self._channel.has_pulses():
                # Enable 0 would let the level fall in the middle of a pulse, and the servo would
                # jerk. A new duty cycle takes effect at the end of the present period.
                self._channel.change_pulses(0.0)
        except ServoError:
            self._lose()
            raise
        self._driving = False

    def close(self) -> None:
        """End the pulses, switch the channel off and unexport it; may be called twice.

        A channel that was already exported and has not been used is not changed, as another process
        may use it. Raises `ServoError` when a step fails; the other steps are done nevertheless.
        """
        if self._closed:
            return
        self._closed = True
        try:
            try:
                self.off()
            finally:
                if self._is_used:
                    self._channel.open(timeout=0.0)  # a failed `off` has closed it
                    self._channel.switch_off(self._period)
        except ServoError:
            if self._is_used:  # otherwise this object never started pulses
                raise
        finally:
            self._channel.close()
            if self._is_used or self._channel.exported:
                self._channel.unexport()

    @classmethod
    def claims(cls, settings: SysfsPwmSettings) -> tuple[Claim, ...]:
        """Return the claim of the pin, or of the channel if one is set."""
        claim, channel = pin(settings.gpio, "servo"), settings.channel
        if channel is None:
            return (claim,)
        what = f"channel {channel} of the kernel's PWM"
        return (Claim(f"{settings.chip or 'pwm'}-{channel}", what, "channel", claim.pins),)

    @classmethod
    def checks(cls, settings: SysfsPwmSettings) -> tuple[Check, ...]:
        """Return the check of the channel."""
        return (Check("pwm", lambda machine: _channel(machine, settings)),)

    @classmethod
    def last_resort(cls, settings: SysfsPwmSettings) -> LastResort:
        """Return how to end the kernel's pulses, which continue after this process."""
        return LastResort(
            "fishd.hardware.servo.pwm_pulses:neutralise",
            {"frequency": settings.frequency, **settings.wires._asdict()},
        )

    @classmethod
    def read_pulses(cls, settings: SysfsPwmSettings) -> bool:
        """Read back from the kernel whether there are pulses."""
        channel = PwmChannel(settings.wires, SystemClock())
        with channel.borrow():
            return channel.has_pulses()

    def _begin(self, width: float) -> None:
        self._is_used = True
        self._channel.start_pulses(width, self._period)
        self._driving = True
        self._reconnects += self._lost
        self._lost = False

    def _check_pulses(self) -> None:
        """Raise `ServoError` if another program has switched the pulses off."""
        if not self._channel.read("enable"):
            raise ServoError(
                f"{self._channel.path}: the servo's pulses were switched off from outside, "
                "such as by 'fishctl release'"
            )

    def _lose(self) -> None:
        """Close a channel that has failed, so that it is opened again."""
        self._driving = False
        self._lost = True
        self._channel.close()


def _channel(machine: Machine, settings: SysfsPwmSettings) -> Result:
    """Check that fishd could open the channel, without changing anything."""
    if occupied := machine.occupied("owns the channel; see daemon"):
        return occupied
    root = str(machine.path(settings.root))
    channel = PwmChannel(settings.wires._replace(root=root), SystemClock())
    try:
        with channel.borrow():
            is_on = channel.has_pulses()
    except ServoError as error:
        return fail(
            str(error),
            "follow this line, then restart",
        )
    if is_on:
        return warning(f"{channel.path}: pulses are on, but no fishd is running", "fishctl release")
    return ok(f"{channel.path} may be written to")
