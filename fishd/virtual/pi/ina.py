"""INA219 and INA226 emulated at the level of their registers; the real drivers run unchanged.

Both convert the shunt voltage and the supply voltage in turn, continuously. The chips have no
thread: at each access they compute the latest conversion. One-shot modes, the registers for current
and power, and alerts are not emulated.
"""

import errno
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

from fishd.core.clock import Clock
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import kernel_error

CONFIG, SHUNT, SUPPLY = range(3)
"""Registers, as numbered by the pointer."""
_RESET_BIT = 0x8000


class InaChip(ABC):
    """Base class of both chips; attach a chip to an `I2cBus`."""

    reset_config: ClassVar[int]
    shunt_step: ClassVar[float]
    """Step of the shunt voltage [V]."""
    fixed: ClassVar[dict[int, int]] = {}
    """Read-only registers that identify the chip."""

    def __init__(
        self,
        clock: Clock,
        power: Callable[[float, float], float],
        faults: Faults,
        supply: float,
        shunt: float,
    ) -> None:
        """
        power: returns the mean power of the servo [W] between two recent times [s]
        supply: voltage behind the shunt [V]
        shunt: resistance of the shunt [Ω]
        """
        self._clock = clock
        self._power = power
        self._faults = faults
        self._supply = supply
        self._shunt = shunt
        self._lock = threading.Lock()
        self.reset()
        faults.listen("meter-unplugged", self.reset)
        faults.listen("meter-brown-out", self.reset)

    @property
    def config(self) -> int:
        """Configuration register."""
        return self._registers[CONFIG]

    def reset(self) -> None:
        """Return to the state after power-up."""
        self._pointer = CONFIG
        self._registers = {CONFIG: self.reset_config}
        self._start = self._clock.monotonic()

    def write(self, data: bytes) -> None:
        """Receive a pointer, and optionally a word for its register."""
        self._check_power()
        with self._lock:
            if data:
                self._pointer = data[0]
            if len(data) < 3:
                return
            word = int.from_bytes(data[1:3], "big")
            if self._pointer == CONFIG and word & _RESET_BIT:
                self.reset()
            elif self._pointer not in (SHUNT, SUPPLY, *self.fixed):
                self._registers[self._pointer] = word
                if self._pointer == CONFIG:
                    self._start = self._clock.monotonic()  # conversions restart

    def read(self, length: int) -> bytes:
        """Return the register of the pointer."""
        self._check_power()
        with self._lock:
            word = self._compute_register(self._pointer)
        return (word.to_bytes(2, "big") + b"\xff" * length)[:length]

    @abstractmethod
    def times(self, config: int) -> tuple[float, float]:
        """Return the conversion times of shunt and supply, including averaging [s]."""

    @abstractmethod
    def supply_word(self, volts: float) -> int:
        """Return the register of the supply voltage."""

    @abstractmethod
    def limit(self, config: int) -> int:
        """Return the largest code of the shunt voltage."""

    def _compute_register(self, pointer: int) -> int:
        if pointer not in (SHUNT, SUPPLY):
            return self.fixed.get(pointer, self._registers.get(pointer, 0))
        config = self._registers[CONFIG]
        shunt, supply = self.times(config)
        completed = int((self._clock.monotonic() - self._start) / (shunt + supply))
        if not completed:
            return 0
        if pointer == SUPPLY:
            return self.supply_word(self._supply)
        begin = self._start + (completed - 1) * (shunt + supply)
        current = self._power(begin, begin + shunt) / self._supply
        limit = self.limit(config)
        return round(min(max(current * self._shunt / self.shunt_step, -limit), limit)) & 0xFFFF

    def _check_power(self) -> None:
        if self._faults.active("meter-unplugged"):
            raise kernel_error(errno.EREMOTEIO)


class Ina219Chip(InaChip):
    """Emulated INA219, Texas Instruments SBOS448."""

    reset_config = 0x399F
    shunt_step = 10e-6

    def times(self, config: int) -> tuple[float, float]:
        """Return the conversion times of shunt and supply, including averaging [s]."""
        return _conversion_time_219(config >> 3 & 0xF), _conversion_time_219(config >> 7 & 0xF)

    def supply_word(self, volts: float) -> int:
        """Return the voltage in steps of 4 mV, with the flags: converted, no overflow."""
        return round(volts / 4e-3) << 3 | 0x2

    def limit(self, config: int) -> int:
        """Return the code of 40 mV, doubled for each step of the gain."""
        return 4000 << (config >> 11 & 3)


class Ina226Chip(InaChip):
    """Emulated INA226, Texas Instruments SBOS547."""

    reset_config = 0x4127
    shunt_step = 2.5e-6
    fixed: ClassVar[dict[int, int]] = {0xFE: 0x5449, 0xFF: 0x2260}

    def times(self, config: int) -> tuple[float, float]:
        """Return the conversion times of shunt and supply, including averaging [s]."""
        average = _AVERAGES_226[config >> 9 & 7]
        return average * _TIMES_226[config >> 3 & 7], average * _TIMES_226[config >> 6 & 7]

    def supply_word(self, volts: float) -> int:
        """Return the voltage in steps of 1.25 mV."""
        return round(volts / 1.25e-3)

    def limit(self, config: int) -> int:
        """Return the code of 81.92 mV."""
        return 0x7FFF


CHIPS: dict[str, type[Ina219Chip] | type[Ina226Chip]] = {"ina219": Ina219Chip, "ina226": Ina226Chip}
"""Chips by the name of their driver."""

_TIMES_226 = (140e-6, 204e-6, 332e-6, 588e-6, 1.1e-3, 2.116e-3, 4.156e-3, 8.244e-3)
_AVERAGES_226 = (1, 4, 16, 64, 128, 256, 512, 1024)


def _conversion_time_219(bits: int) -> float:
    """Return the time of a conversion with 9 to 12 bits, or of 2 to 128 with 12 bits [s]."""
    if bits & 8:
        return float(532e-6 * 2 ** (bits & 7))
    return (84e-6, 148e-6, 276e-6, 532e-6)[bits & 3]
