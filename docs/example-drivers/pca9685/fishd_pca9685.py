"""`pca9685`: the servo on one of the sixteen channels of a PCA9685, on the I2C bus.

Registers are those of the data sheet: NXP, "PCA9685, 16-channel, 12-bit PWM Fm+ I2C-bus LED
controller", Rev. 4, tables 4 to 8 and section 7.3. A period has 4096 counts; a channel goes high at
its count ON and low at its count OFF. The chip continues its pulses after the process that started
them has ended, so the driver has a last resort.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from types import SimpleNamespace
from typing import Annotated, Any

from msgspec import Meta

from fishd.core.errors import ServoError
from fishd.hardware import i2c
from fishd.hardware.driver import (
    Check,
    Claim,
    LastResort,
    Machine,
    Result,
    ServoDriver,
    ServoSettings,
    note,
    unit,
)

MODE1, LED0, PRE_SCALE = 0x00, 0x06, 0xFE
"""Addresses of registers; a channel has four: ON low, ON high, OFF low, OFF high."""
SLEEP, AUTO_INCREMENT, RESTART = 0x10, 0x20, 0x80
"""Bits of MODE1. PRE_SCALE can be written only in SLEEP; writing 1 to RESTART clears RESTART."""
FULL_OFF = 0x10
"""Bit of OFF high that ends the pulses, whatever the counts are; set after power-on."""
START_UP_S = 500e-6
"""Start-up time of the oscillator after SLEEP [s]."""
COUNTS = 4096
"""Number of counts of a period."""
NEUTRAL_TIME_S = 0.3
"""Time at neutral before the pulses end [s]."""


class Pca9685Settings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Chip and channel of the servo, and frequency of the pulses."""

    bus: Annotated[i2c.Bus, note("I2C bus: N of /dev/i2c-N.")] = 1
    address: Annotated[int, note("I2C address, 0x40 and up; 64 is 0x40.", ge=0x40, le=0x7F)] = 64
    channel: Annotated[int, note("Channel of the servo.", ge=0, le=15)] = 0
    frequency: Annotated[
        float, unit("Hz", "Pulses per second, of all channels.", ge=40, le=333)
    ] = 50.0
    oscillator: Annotated[
        Annotated[float, Meta(ge=20e6, le=30e6)],
        unit("Hz", "Frequency of the oscillator, about 25 MHz; measure a pulse to correct it."),
    ] = 25e6

    @property
    def pulse_period(self) -> float:
        """Period of the pulses [s]."""
        return 1.0 / self.frequency


class Pca9685(ServoDriver[Pca9685Settings]):
    """Driver of a servo on a PCA9685 board."""

    Settings = Pca9685Settings
    packages = ("adafruit-extended-bus",)

    def open(self) -> None:
        """Find the chip, or continue without it; raise ImportError without the library."""
        import adafruit_extended_bus  # noqa: F401  (is it there?)

        self._chip: Chip | None = None
        self._driving = False
        self._opened = 0
        with suppress(ServoError):  # each write tries again, and reports the error
            self._find()

    def write(self, pulse: float) -> None:
        """Send pulses [µs]; after a `ServoError`, the next write opens the bus again."""
        chip = self._chip or self._find()
        with raising_servo_errors(self.settings, self._close_bus):
            if not self._driving:
                chip.set_up(self.clock.sleep)
            elif chip.off():
                # After a power-on or `fishctl release`, a tick may not start the pulses again.
                self._driving = False
                raise ServoError(
                    f"{self._place}: the pulses were switched off from outside, by 'fishctl "
                    "release' or a reset: check its power"
                )
            chip.send(pulse)
        self._driving = True

    def off(self) -> None:
        """End the pulses at once; the last pulse may be cut short."""
        chip = self._chip or self._find()
        with raising_servo_errors(self.settings, self._close_bus):
            chip.end()
        self._driving = False

    def close(self) -> None:
        """End the pulses that this object started; those of other channels continue."""
        try:
            if self._driving:
                self.off()
        finally:
            self._close_bus()

    def counters(self) -> dict[str, int]:
        """Return the number of times that the bus was opened again."""
        return {"servo_reconnects": max(0, self._opened - 1)}

    @classmethod
    def claims(cls, settings: Pca9685Settings) -> tuple[Claim, ...]:
        """Return the claim of the bus, which a force sensor of the same fishd may share."""
        return (i2c.claim(settings.bus),)

    @classmethod
    def checks(cls, settings: Pca9685Settings) -> tuple[Check, ...]:
        """Return the checks of the bus and of the chip."""
        chip = Check("pca9685", lambda machine: check_chip(machine, settings))
        return (*i2c.checks(settings.bus, "servo"), chip)

    @classmethod
    def last_resort(cls, settings: Pca9685Settings) -> LastResort:
        """Return a function that ends the pulses, which outlive this process."""
        keys = ("bus", "address", "channel", "frequency", "oscillator")
        return LastResort(f"{__name__}:neutralise", {key: getattr(settings, key) for key in keys})

    @property
    def _place(self) -> str:
        return f"the PCA9685 at {self.settings.address:#04x} on /dev/i2c-{self.settings.bus}"

    def _find(self) -> "Chip":
        with raising_servo_errors(self.settings, self._close_bus):
            self._chip = Chip(self.settings)
            self._chip.off()  # raises if the chip does not answer
            self._opened += 1
        return self._chip

    def _close_bus(self) -> None:
        self._driving = False
        chip, self._chip = self._chip, None
        if chip:
            chip.close()


@contextmanager
def raising_servo_errors(settings: Any, close_bus: Callable[[], None]) -> Iterator[None]:
    """Close the bus after an OSError, and raise a `ServoError` instead."""
    try:
        yield
    except ServoError:
        raise
    except OSError as error:
        close_bus()
        words = i2c.explain(error, settings.bus, settings.address, "PCA9685", "servo")
        raise ServoError(words) from None


class Chip:
    """One channel of a PCA9685; each method raises OSError if a transfer fails."""

    def __init__(self, settings: Any) -> None:
        """settings: those of the driver, or an object with the keys of `last_resort`"""
        self._bus: Any = i2c.open_bus(settings.bus)
        self._bus.try_lock()
        self._address = settings.address
        self._first = LED0 + 4 * settings.channel
        self.pre_scale = round(settings.oscillator / (COUNTS * settings.frequency)) - 1
        self._counts_per_us = 1e-6 * settings.oscillator / (self.pre_scale + 1)

    def set_up(self, sleep: Callable[[float], None]) -> None:
        """Start the oscillator with the frequency of the settings; no channel begins pulses."""
        mode = self.read(MODE1)
        if self.read(PRE_SCALE) != self.pre_scale:
            self._write(MODE1, mode & ~RESTART | SLEEP)
            self._write(PRE_SCALE, self.pre_scale)
            mode = self.read(MODE1)
        if mode & (SLEEP | AUTO_INCREMENT) != AUTO_INCREMENT:
            self._write(MODE1, mode & ~(SLEEP | RESTART) | AUTO_INCREMENT)
            sleep(START_UP_S)
        if mode & RESTART:  # other channels had pulses before SLEEP
            self._write(MODE1, mode & ~SLEEP | AUTO_INCREMENT | RESTART)

    def off(self) -> bool:
        """Return whether this channel has no pulses."""
        return bool(self.read(self._first + 3) & FULL_OFF or self.read(MODE1) & SLEEP)

    def send(self, pulse: float) -> None:
        """Send a pulse [µs] from count 0; all four registers are written in one transfer."""
        count = round(pulse * self._counts_per_us)
        self._write(self._first, 0, 0, count & 0xFF, count >> 8)

    def end(self) -> None:
        """End the pulses."""
        self._write(self._first + 3, FULL_OFF)

    def read(self, register: int) -> int:
        """Return the value of a register."""
        data = bytearray(1)
        self._bus.writeto_then_readfrom(self._address, bytes([register]), data)
        return data[0]

    def close(self) -> None:
        """Close the bus."""
        i2c.close_bus(self._bus)

    def _write(self, register: int, *values: int) -> None:
        self._bus.writeto(self._address, bytes([register, *values]))


def neutralise(neutral: float, *, sleep: Callable[[float], None] = time.sleep, **keys: Any) -> bool:
    """Move a servo that gets pulses to neutral [µs], then end its pulses: the last resort."""
    settings = SimpleNamespace(**keys)
    with raising_servo_errors(settings, lambda: None), closing(Chip(settings)) as chip:
        if chip.off():
            return False
        try:
            chip.set_up(sleep)
            chip.send(neutral)
            sleep(NEUTRAL_TIME_S)
        finally:
            chip.end()
    return True


def check_chip(machine: Machine, settings: Pca9685Settings) -> Result:
    """Check that the chip answers, and that no pulses were left on."""
    if occupied := machine.occupied("owns the bus; see daemon"):
        return occupied
    try:
        with closing(Chip(settings)) as chip:
            silent, pre_scale = chip.off(), chip.read(PRE_SCALE)
    except OSError as error:
        return Result(
            "FAIL",
            i2c.explain(error, settings.bus, settings.address, "PCA9685", "servo"),
            f"'i2cdetect -y {settings.bus}' (package i2c-tools) lists which addresses answer",
        )
    if not silent:
        return Result("warning", "pulses are on, but no fishd is running", "fishctl release")
    return Result(
        "ok", f"a PCA9685 answers, set to {settings.oscillator / COUNTS / (pre_scale + 1):.1f} Hz"
    )
