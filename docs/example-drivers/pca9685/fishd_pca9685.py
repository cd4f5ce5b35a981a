"""`pca9685`: the servo on one of the sixteen channels of a PCA9685, on the I2C bus.

Registers are those of the data sheet: NXP, "PCA9685, 16-channel, 12-bit PWM Fm+ I2C-bus LED
controller", Rev. 4, tables 4 to 8 and section 7.3. A period has 4096 counts; a channel goes high at
its count ON and low at its count OFF. The chip goes on when the process that made the pulses is
dead, so that there is a last resort.
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
"""Registers; of each channel there are four: ON low, ON high, OFF low, OFF high."""
SLEEP, AUTO_INCREMENT, RESTART = 0x10, 0x20, 0x80
"""Bits of MODE1. PRE_SCALE can be written only in SLEEP; a write of 1 to RESTART ends that."""
FULL_OFF = 0x10
"""Of OFF high: no pulses, whatever the counts are. So it is after power-on."""
START_UP = 500e-6
"""Time until the oscillator runs, once SLEEP is over [s]."""
COUNTS = 4096
REST = 0.3
"""Time at neutral before the pulses end [s]."""


class Pca9685Settings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which chip, which channel."""

    bus: Annotated[i2c.Bus, note("I2C bus: N of /dev/i2c-N.")] = 1
    address: Annotated[int, note("I2C address, 0x40 and up; 64 is 0x40.", ge=0x40, le=0x7F)] = 64
    channel: Annotated[int, note("Channel that the servo is on.", ge=0, le=15)] = 0
    frequency: Annotated[
        float, unit("Hz", "Pulses per second, of all channels.", ge=40, le=333)
    ] = 50.0
    oscillator: Annotated[
        Annotated[float, Meta(ge=20e6, le=30e6)],
        unit("Hz", "The chip's own, 25 MHz give or take; measure a pulse and correct it here."),
    ] = 25e6


class Pca9685(ServoDriver[Pca9685Settings]):
    """A servo on a PCA9685 board."""

    Settings = Pca9685Settings
    packages = ("adafruit-extended-bus",)

    def open(self) -> None:
        """Look for the chip and change nothing, or go on without; ImportError without a library."""
        import adafruit_extended_bus  # noqa: F401  (is it there?)

        self._chip: Chip | None = None
        self._driving = False
        self._opened = 0
        with suppress(ServoError):  # each write tries again, and says what is wrong
            self._find()

    def write(self, pulse: float) -> None:
        """Send pulses [µs]; raises `ServoError`, and the next write opens the bus again."""
        chip = self._chip or self._find()
        with explained(self.settings, self._let_go):
            if not self._driving:
                chip.set_up(self.clock.sleep)
            elif chip.off():
                # After a power-on or `fishctl release`: to begin again is not for a tick to decide.
                self._driving = False
                raise ServoError(
                    f"{self._place}: the pulses were switched off from outside, by 'fishctl "
                    "release' or a reset: check its power"
                )
            chip.send(pulse)
        self._driving = True

    def off(self) -> None:
        """End the pulses at once: the last one may be cut short."""
        chip = self._chip or self._find()
        with explained(self.settings, self._let_go):
            chip.end()
        self._driving = False

    def close(self) -> None:
        """End the pulses, if there were any of ours; other channels go on."""
        try:
            if self._driving:
                self.off()
        finally:
            self._let_go()

    def counters(self) -> dict[str, int]:
        """How often the bus was opened again since start."""
        return {"servo_reconnects": max(0, self._opened - 1)}

    @classmethod
    def claims(cls, settings: Pca9685Settings) -> tuple[Claim, ...]:
        """The bus; a force sensor of the same fishd may be on it, too."""
        return (i2c.claim(settings.bus),)

    @classmethod
    def checks(cls, settings: Pca9685Settings) -> tuple[Check, ...]:
        """Of the bus, and of the chip."""
        chip = Check("pca9685", lambda machine: answers(machine, settings))
        return (*i2c.checks(settings.bus, "servo"), chip)

    @classmethod
    def last_resort(cls, settings: Pca9685Settings) -> LastResort:
        """The chip knows nothing of this process, and goes on."""
        keys = ("bus", "address", "channel", "frequency", "oscillator")
        return LastResort(f"{__name__}:neutralise", {key: getattr(settings, key) for key in keys})

    @property
    def _place(self) -> str:
        return f"the PCA9685 at {self.settings.address:#04x} on /dev/i2c-{self.settings.bus}"

    def _find(self) -> "Chip":
        with explained(self.settings, self._let_go):
            self._chip = Chip(self.settings)
            self._chip.off()  # does it answer?
            self._opened += 1
        return self._chip

    def _let_go(self) -> None:
        self._driving = False
        chip, self._chip = self._chip, None
        if chip:
            chip.close()


@contextmanager
def explained(settings: Any, let_go: Callable[[], None]) -> Iterator[None]:
    """Turns an OSError of the bus into a `ServoError`, once the bus is let go of."""
    try:
        yield
    except ServoError:
        raise
    except OSError as error:
        let_go()
        words = i2c.explain(error, settings.bus, settings.address, "PCA9685", "servo")
        raise ServoError(words) from None


class Chip:
    """One channel of a PCA9685; each method raises OSError where a transfer fails."""

    def __init__(self, of: Any) -> None:
        """of: its settings, or the same keys of them that `last_resort` leaves"""
        self._bus: Any = i2c.open_bus(of.bus)
        self._bus.try_lock()
        self._address = of.address
        self._first = LED0 + 4 * of.channel
        self.pre_scale = round(of.oscillator / (COUNTS * of.frequency)) - 1
        self._counts_per_us = 1e-6 * of.oscillator / (self.pre_scale + 1)

    def set_up(self, sleep: Callable[[float], None]) -> None:
        """Wake it up at our frequency; a channel without pulses stays so."""
        mode = self.read(MODE1)
        if self.read(PRE_SCALE) != self.pre_scale:
            self._write(MODE1, mode & ~RESTART | SLEEP)
            self._write(PRE_SCALE, self.pre_scale)
            mode = self.read(MODE1)
        if mode & (SLEEP | AUTO_INCREMENT) != AUTO_INCREMENT:
            self._write(MODE1, mode & ~(SLEEP | RESTART) | AUTO_INCREMENT)
            sleep(START_UP)
        if mode & RESTART:  # other channels had pulses when it was put to sleep
            self._write(MODE1, mode & ~SLEEP | AUTO_INCREMENT | RESTART)

    def off(self) -> bool:
        """Whether this channel has no pulses."""
        return bool(self.read(self._first + 3) & FULL_OFF or self.read(MODE1) & SLEEP)

    def send(self, pulse: float) -> None:
        """High from count 0 on, for a pulse [µs]; all four registers in one transfer."""
        count = round(pulse * self._counts_per_us)
        self._write(self._first, 0, 0, count & 0xFF, count >> 8)

    def end(self) -> None:
        """No more pulses."""
        self._write(self._first + 3, FULL_OFF)

    def read(self, register: int) -> int:
        """A register."""
        found = bytearray(1)
        self._bus.writeto_then_readfrom(self._address, bytes([register]), found)
        return found[0]

    def close(self) -> None:
        """Let go of the bus."""
        i2c.close_bus(self._bus)

    def _write(self, register: int, *values: int) -> None:
        self._bus.writeto(self._address, bytes([register, *values]))


def neutralise(neutral: float, *, sleep: Callable[[float], None] = time.sleep, **keys: Any) -> bool:
    """Last resort: a servo that gets pulses goes to neutral [µs], then they end."""
    settings = SimpleNamespace(**keys)
    with explained(settings, lambda: None), closing(Chip(settings)) as chip:
        if chip.off():
            return False
        try:
            chip.set_up(sleep)
            chip.send(neutral)
            sleep(REST)
        finally:
            chip.end()
    return True


def answers(machine: Machine, settings: Pca9685Settings) -> Result:
    """Whether the chip answers, and nobody has left pulses on."""
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
