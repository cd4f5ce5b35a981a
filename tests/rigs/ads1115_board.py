"""Emulated ADS1115 behind an emulated /dev/i2c-N, by default in virtual time."""

from collections.abc import Sequence
from typing import Any, Self

from adafruit_ads1x15 import ADS1115
from adafruit_extended_bus import ExtendedI2C

from fishd.core.clock import VirtualClock
from fishd.virtual.pi.ads1115 import Ads1115Chip
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import I2cBus, Message, Read, Write
from fishd.virtual.pi.linux_i2c import LinuxI2c

VOLTS = [0.5, -0.3, 0.1, -0.25, 1.0, 0.7, 0.0, 1.9]
"""Mean voltage of each input, by mux bits."""

X, Y = 0, 3
"""Mux bits of the inputs A0-A1 and A2-A3."""

ABSENT_BUS = 201
"""Bus that exists only while a board exists; a Pi may have a real bus 1."""


class Board:
    """Chip on a bus, with the parts that a test observes or changes.

    A context manager, during which the bus has a device file.
    """

    def __init__(
        self,
        speed: float = 400e3,
        noise: float = 0.0,
        seed: int = 0,
        clock: Any = None,
        bits: int = 16,
    ) -> None:
        self.clock = clock or VirtualClock()
        self.faults = Faults(self.clock, seed)
        self.bus = I2cBus(self.clock, speed, self.faults)
        self.volts: Any = list(VOLTS)
        self.measured: list[tuple[int, float, float]] = []
        self.chip = Ads1115Chip(self.clock, self.input, self.faults, noise, seed, bits)
        self.bus.attach(0x48, self.chip)
        self.device = LinuxI2c(self.transfer, {1, ABSENT_BUS}, self.set_timeout)

    def __enter__(self) -> Self:
        self.device.install()
        return self

    def __exit__(self, *_: object) -> None:
        self.device.remove()

    def input(self, mux: int, start: float, end: float) -> float:
        self.measured.append((mux, start, end))
        return self.volts[mux]

    def transfer(self, address: int, messages: Sequence[Message]) -> list[bytes]:
        return self.bus.transfer(address, messages)

    def driver(self, **options: float) -> ADS1115:
        options.setdefault("data_rate", 860)
        return ADS1115(ExtendedI2C(ABSENT_BUS, frequency=None), **options)

    def register(self, pointer: int) -> int:
        (word,) = self.bus.transfer(0x48, [Write(bytes([pointer])), Read(2)])
        return int.from_bytes(word, "big")

    def configure(self, word: int) -> None:
        self.bus.transfer(0x48, [Write(b"\x01" + word.to_bytes(2, "big"))])

    def set_timeout(self, seconds: float) -> None:
        self.bus.timeout = seconds

    def wait(self, rate: float = 860.0) -> None:
        """Wait until any conversion at that rate has ended."""
        self.clock.sleep(1.25 / rate + 1e-3)


def codes(volts: float, full_scale: float = 4.096) -> int:
    return round(volts / full_scale * 0x8000)


def config(mux: int, *, rate: int = 7) -> int:
    """Return a single-shot config at ±4.096 V."""
    return 0x8000 | mux << 12 | 1 << 9 | 0x100 | rate << 5 | 3
