"""ADS1115 or ADS1015 emulated at the level of its registers; the real driver runs unchanged on it.

The chip has no thread: at each access it computes the conversions since the previous one. Only the
single-shot mode is emulated. The comparator is not: the ALERT pin is not connected.
"""

import errno
import logging
import random
import threading
from collections.abc import Callable
from typing import NamedTuple

from fishd.core.clock import Clock
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import kernel_error

log = logging.getLogger(__name__)

CONVERSION, CONFIG, LOW_THRESHOLD, HIGH_THRESHOLD = range(4)
"""Registers, as numbered by the pointer."""

RESET_CONFIG = 0x0583
"""Config register after a reset, without its OS bit."""

FULL_SCALE = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
"""Full scale for each value of the gain bits [V]."""

DATA_RATES = {
    16: (8, 16, 32, 64, 128, 250, 475, 860),
    12: (128, 250, 490, 920, 1600, 2400, 3300, 3300),
}
"""Nominal data rate for each value of the rate bits [1/s], by the number of bits of the chip."""

POWER_UP = 25e-6
"""Time to wake up before a conversion [s]."""

_IDLE_BIT, _SINGLE_SHOT, _COMPARATOR_OFF = 0x8000, 0x0100, 0x0003


class _Conversion(NamedTuple):
    """Running conversion, with the config at its start."""

    start: float
    end: float
    config: int


class Ads1115Chip:
    """Emulated chip; attach it to an `I2cBus`."""

    def __init__(
        self,
        clock: Clock,
        volts: Callable[[int, float, float], float],
        faults: Faults,
        noise: float = 1.0,
        seed: int = 0,
        bits: int = 16,
    ) -> None:
        """
        volts: returns the mean voltage [V] of an input, given its mux bits (0 to 7), start and
            end [s]
        noise: rms noise of a conversion, in steps of an ADS1115
        seed: seed of the noise, and of the error of the data rate, within ±10 %
        bits: 16 for an ADS1115; 12 for an ADS1015, whose codes and thresholds end with four zeros
        """
        self._clock = clock
        self._volts = volts
        self._faults = faults
        self._noise = noise
        self._step = 1 << 16 - bits
        self._rates = DATA_RATES[bits]
        self._random = random.Random(seed)
        self.rate_factor = self._random.uniform(0.9, 1.1)
        self._lock = threading.RLock()
        self._last_codes: dict[int, int] = {}
        self._logged: set[str] = set()
        self.reset()
        faults.listen("brown-out", self.reset)
        faults.listen("unplugged", self.reset)

    def reset(self) -> None:
        """Return to the state after power-up; a running conversion is lost."""
        with self._lock:
            self._pointer = CONVERSION
            self._registers = [0, RESET_CONFIG, 0x8000, self._rounded_down(0x7FFF)]
            self._conversion: _Conversion | None = None

    def write(self, data: bytes) -> None:
        """Receive [pointer] or [pointer, high byte, low byte]; OSError EREMOTEIO without power."""
        self._check_power()
        if not data:
            return
        with self._lock:
            now = self._catch_up()
            self._pointer = data[0] & 3
            if len(data) >= 3 and self._pointer != CONVERSION:
                self._store(int.from_bytes(data[1:3], "big"), now)

    def read(self, length: int) -> bytes:
        """Return the register of the pointer, high byte first; further bytes are FF."""
        self._check_power()
        with self._lock:
            self._catch_up()
            word = self._registers[self._pointer]
            busy = self._conversion is not None or self._faults.active("stuck-busy")
            if self._pointer == CONFIG and not busy:
                word |= _IDLE_BIT
            return (word.to_bytes(2, "big") + b"\xff" * length)[:length]

    def _check_power(self) -> None:
        if self._faults.active("unplugged"):
            raise kernel_error(errno.EREMOTEIO)

    def _store(self, word: int, now: float) -> None:
        if self._pointer != CONFIG:
            self._registers[self._pointer] = self._rounded_down(word)
            return
        self._registers[CONFIG] = config = word & ~_IDLE_BIT
        if not config & _SINGLE_SHOT:
            self._warn_once("continuous mode is not emulated: it converts nothing")
        elif config & _COMPARATOR_OFF != _COMPARATOR_OFF:
            self._warn_once("the comparator is not emulated: ALERT stays silent")
        # A busy chip ignores the start, but stores the config for the next conversion.
        idle = self._conversion is None and not self._faults.active("stuck-busy")
        if word & _IDLE_BIT and config & _SINGLE_SHOT and idle:
            start = now + POWER_UP
            rate = self._rates[config >> 5 & 7] * self.rate_factor
            self._conversion = _Conversion(start, start + 1.0 / rate, config)

    def _warn_once(self, message: str) -> None:
        if message not in self._logged:
            self._logged.add(message)
            log.warning("emulated ADS1115: %s", message)

    def _catch_up(self) -> float:
        """Complete a conversion that has ended by now; return the time [s]."""
        now = self._clock.monotonic()
        current = self._conversion
        if current and current.end <= now and not self._faults.active("stuck-busy"):
            self._conversion = None
            self._registers[CONVERSION] = self._code(current) & 0xFFFF
        return now

    def _code(self, conversion: _Conversion) -> int:
        """Return the result of a conversion."""
        start, end, config = conversion
        mux = config >> 12 & 7
        largest = self._rounded_down(0x7FFF)
        if self._faults.active("clipped"):
            code = largest
        elif self._faults.active("frozen-code"):
            code = self._last_codes.get(mux, self._registers[CONVERSION])
        else:
            steps = self._volts(mux, start, end) / FULL_SCALE[config >> 9 & 7] * 0x8000
            noisy = self._random.gauss(steps, self._noise) if self._noise else steps
            code = min(max(round(noisy / self._step) * self._step, -0x8000), largest)
        self._last_codes[mux] = code
        return code

    def _rounded_down(self, word: int) -> int:
        """Return a register's value without the bits that the chip does not have."""
        return word & -self._step
