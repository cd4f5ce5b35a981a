"""An INA219 and an INA226 at the level of their registers, on which the real drivers run unchanged.

Both convert the voltages over the shunt and of the supply in turn, without an end; nothing ticks:
at each access the chip works out what it has converted last. One-shot modes, the registers for
current and power, and alerts are not emulated.
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
"""What the pointer points at."""
_RESET_BIT = 0x8000


class InaChip(ABC):
    """What the two have in common; put one on an `I2cBus`."""

    reset_config: ClassVar[int]
    shunt_step: ClassVar[float]
    """[V]"""
    fixed: ClassVar[dict[int, int]] = {}
    """Registers that only tell who it is."""

    def __init__(
        self,
        clock: Clock,
        power: Callable[[float, float], float],
        faults: Faults,
        supply: float,
        shunt: float,
    ) -> None:
        """power: from a time to another one [s], of late: what the servo takes meanwhile [W]

        supply: behind the shunt [V]; shunt [Ω]
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
        """The register that says how it converts."""
        return self._registers[CONFIG]

    def reset(self) -> None:
        """Go back to the state after power-up."""
        self._pointer = CONFIG
        self._registers = {CONFIG: self.reset_config}
        self._begun = self._clock.monotonic()

    def write(self, data: bytes) -> None:
        """A pointer, and a word for that register perhaps."""
        self._need_power()
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
                    self._begun = self._clock.monotonic()  # what was under way begins anew

    def read(self, length: int) -> bytes:
        """The register that was pointed at last."""
        self._need_power()
        with self._lock:
            word = self._word(self._pointer)
        return (word.to_bytes(2, "big") + b"\xff" * length)[:length]

    @abstractmethod
    def times(self, config: int) -> tuple[float, float]:
        """How long the shunt and the supply are converted, with all averaging [s]."""

    @abstractmethod
    def supply_word(self, volts: float) -> int:
        """The register of the supply."""

    @abstractmethod
    def limit(self, config: int) -> int:
        """The largest code of the shunt."""

    def _word(self, pointer: int) -> int:
        if pointer not in (SHUNT, SUPPLY):
            return self.fixed.get(pointer, self._registers.get(pointer, 0))
        config = self._registers[CONFIG]
        shunt, supply = self.times(config)
        done = int((self._clock.monotonic() - self._begun) / (shunt + supply))
        if not done:
            return 0
        if pointer == SUPPLY:
            return self.supply_word(self._supply)
        begin = self._begun + (done - 1) * (shunt + supply)
        current = self._power(begin, begin + shunt) / self._supply
        most = self.limit(config)
        return round(min(max(current * self._shunt / self.shunt_step, -most), most)) & 0xFFFF

    def _need_power(self) -> None:
        if self._faults.active("meter-unplugged"):
            raise kernel_error(errno.EREMOTEIO)


class Ina219Chip(InaChip):
    """SBOS448 of Texas Instruments."""

    reset_config = 0x399F
    shunt_step = 10e-6

    def times(self, config: int) -> tuple[float, float]:
        """As of `InaChip`."""
        return _time_219(config >> 3 & 0xF), _time_219(config >> 7 & 0xF)

    def supply_word(self, volts: float) -> int:
        """In steps of 4 mV, beside two flags: converted, and no overflow."""
        return round(volts / 4e-3) << 3 | 0x2

    def limit(self, config: int) -> int:
        """40 mV, and twice as much with each step of the gain."""
        return 4000 << (config >> 11 & 3)


class Ina226Chip(InaChip):
    """SBOS547 of Texas Instruments."""

    reset_config = 0x4127
    shunt_step = 2.5e-6
    fixed: ClassVar[dict[int, int]] = {0xFE: 0x5449, 0xFF: 0x2260}

    def times(self, config: int) -> tuple[float, float]:
        """As of `InaChip`."""
        average = _AVERAGES_226[config >> 9 & 7]
        return average * _TIMES_226[config >> 3 & 7], average * _TIMES_226[config >> 6 & 7]

    def supply_word(self, volts: float) -> int:
        """In steps of 1.25 mV."""
        return round(volts / 1.25e-3)

    def limit(self, config: int) -> int:
        """Always 81.92 mV."""
        return 0x7FFF


CHIPS: dict[str, type[Ina219Chip] | type[Ina226Chip]] = {"ina219": Ina219Chip, "ina226": Ina226Chip}
"""By the name of the driver of each."""

_TIMES_226 = (140e-6, 204e-6, 332e-6, 588e-6, 1.1e-3, 2.116e-3, 4.156e-3, 8.244e-3)
_AVERAGES_226 = (1, 4, 16, 64, 128, 256, 512, 1024)


def _time_219(bits: int) -> float:
    """Of a conversion at 9 to 12 bits, or of 2 to 128 of them at 12 [s]."""
    if bits & 8:
        return float(532e-6 * 2 ** (bits & 7))
    return (84e-6, 148e-6, 276e-6, 532e-6)[bits & 3]
