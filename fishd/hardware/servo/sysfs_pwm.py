"""The servo through the kernel's PWM: exact pulses on a Pi 5, and wherever there is no pigpiod.

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
from fishd.hardware.servo import pwm_pulses
from fishd.hardware.servo.pwm_channel import Files, PwmChannel, Wires
from fishd.hardware.servo.pwm_pulses import PATIENCE
from fishd.hardware.settings import Gpio, ServoSettings


class SysfsPwmSettings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which channel of the kernel's PWM drives the servo."""

    gpio: Annotated[Gpio, note("Pin of the servo's signal, Broadcom number.")] = 18
    frequency: Annotated[
        float, unit("Hz", "Pulses per second; more than 50 for digital servos only.", ge=40, le=333)
    ] = 50.0
    root: Annotated[str, note("Folder of the PWM chips.")] = "/sys/class/pwm"
    chip: Annotated[
        str | None,
        note("Device of the chip, such as 1f00098000.pwm; null: that of the Pi's header."),
    ] = None
    channel: Annotated[
        Annotated[int, Meta(ge=0, le=15)] | None,
        note("Channel of the chip; null: the one that servo.gpio is wired to."),
    ] = None

    @property
    def wires(self) -> Wires:
        """What the channel is found by."""
        return Wires(self.gpio, self.root, self.chip, self.channel)


class SysfsPwm(ServoDriver[SysfsPwmSettings]):
    """A servo on one channel of the kernel's PWM."""

    Settings = SysfsPwmSettings

    def __init__(self, *given: Any, files: Files = os, **named: Any) -> None:
        """files: where the channel's files are; by default those of this machine"""
        self._files = files
        super().__init__(*given, **named)

    def open(self) -> None:
        """Open the channel and leave its pulses as they are, or go on without and keep trying."""
        self._period = 1.0 / self.settings.frequency
        self._driving = False  # pulses of ours are on
        self._owned = False  # the channel was used: it has to be unexported
        self._closed = False
        self._lost = False
        self._reconnects = 0
        self._channel = PwmChannel(self.settings.wires, self.clock, self._files)
        # Each `write` and `off` tries again, and says what is wrong.
        with suppress(ServoError):
            self._channel.open(PATIENCE)

    def counters(self) -> dict[str, int]:
        """How often the channel was opened again since start."""
        return {"servo_reconnects": self._reconnects}

    def write(self, pulse: float) -> None:
        """Send a pulse [µs], and begin where there were none.

        Raises `ServoError`; after that, each write tries to open the channel again, at once.
        """
        try:
            if self._driving:
                self._check_pulses()
                self._channel.write("duty_cycle", pwm_pulses.nanoseconds(pulse))
            else:
                self._channel.open(patience=0.0)
                self._begin(pulse)
        except ServoError:
            self._lose()
            raise

    def off(self) -> None:
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
        """End the pulses, switch the channel off and unexport it; may be called twice.

        A channel that was already exported and has not been used is left alone, as another process
        may hold it. Raises `ServoError` when that fails; no step is left out because of another.
        """
        if self._closed:
            return
        self._closed = True
        try:
            try:
                self.off()
            finally:
                if self._owned:
                    self._channel.open(patience=0.0)  # an `off` that fails closes it
                    pwm_pulses.switch_off(self._channel, self._period, self.clock.sleep)
        except ServoError:
            if self._owned:  # else there never were pulses of ours
                raise
        finally:
            self._channel.close()
            if self._owned or self._channel.exported:
                self._channel.unexport()

    @classmethod
    def claims(cls, settings: SysfsPwmSettings) -> tuple[Claim, ...]:
        """Its pin, or the channel where that is named."""
        claim, channel = pin(settings.gpio, "servo"), settings.channel
        if channel is None:
            return (claim,)
        what = f"channel {channel} of the kernel's PWM"
        return (Claim(f"{settings.chip or 'pwm'}-{channel}", what, "channel", claim.pins),)

    @classmethod
    def checks(cls, settings: SysfsPwmSettings) -> tuple[Check, ...]:
        """Of the channel."""
        return (Check("pwm", lambda machine: _channel(machine, settings)),)

    @classmethod
    def last_resort(cls, settings: SysfsPwmSettings) -> LastResort:
        """The kernel's pulses go on until somebody ends them."""
        return LastResort(
            "fishd.hardware.servo.pwm_pulses:neutralise",
            {"frequency": settings.frequency, **settings.wires._asdict()},
        )

    @classmethod
    def read_pulses(cls, settings: SysfsPwmSettings) -> bool:
        """Ask the kernel."""
        channel = PwmChannel(settings.wires, SystemClock(), os)
        try:
            channel.open(PATIENCE)
            return pwm_pulses.on(channel)
        finally:
            channel.close()
            if channel.exported:
                channel.unexport()

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


def _channel(machine: Machine, settings: SysfsPwmSettings) -> Result:
    """Open the channel as fishd does, and leave everything as it was."""
    if occupied := machine.occupied("owns the channel; see daemon"):
        return occupied
    root = str(machine.path(settings.root))
    channel = PwmChannel(settings.wires._replace(root=root), SystemClock())
    try:
        channel.open(PATIENCE)
        duty = channel.read("enable") and channel.read("duty_cycle")
    except ServoError as error:
        return fail(
            str(error), "do as it says, and restart; 'make install-pi' gives group gpio its files"
        )
    finally:
        channel.close()
        if channel.exported:
            channel.unexport()
    if duty:
        return warning(f"{channel.path}: pulses are on, but no fishd is running", "fishctl release")
    return ok(f"{channel.path} may be written to")
