"""An ADS1115 at the level of its registers, on which the real driver runs unchanged.

Nothing ticks: at each access the chip works out what it has converted since the last one.
"""

import errno
import math
import random
import threading
from collections.abc import Callable
from typing import NamedTuple

from fishd.clock import Clock
from fishd.emulation.ads1115_comparator import QUEUES, READY_PULSE, Comparator
from fishd.emulation.faults import Faults
from fishd.emulation.i2c import kernel_error

CONVERSION, CONFIG, LOW_THRESHOLD, HIGH_THRESHOLD = range(4)
"""What the pointer points at."""

RESET_CONFIG = 0x0583
"""Config register after a reset, less its OS bit."""

FULL_SCALE = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
"""Range by gain bits [V]."""

DATA_RATES = (8, 16, 32, 64, 128, 250, 475, 860)
"""Conversions per second by rate bits, nominal."""

POWER_UP = 25e-6
"""Time to wake up before a conversion [s]."""

_IDLE_BIT, _SINGLE_SHOT = 0x8000, 0x0100
_REMEMBERED = 4  # conversions made up for in continuous mode: the longest queue of the comparator


class _Conversion(NamedTuple):
    """A conversion under way, with the config that was in force when it began."""

    start: float
    end: float
    config: int


class Ads1115Chip:
    """The chip; put it on an `I2cBus`."""

    def __init__(
        self,
        clock: Clock,
        volts: Callable[[int, float, float], float],
        faults: Faults,
        noise: float = 1.0,
        seed: int = 0,
        zero_length_probe: bool = True,
    ) -> None:
        """What the chip is and what it measures.

        volts: (mux bits 0..7, start, end [s]) to the mean voltage of that input in that time [V]
        noise: of a conversion, rms, in steps of the ADC
        seed: of the noise, and of how far this chip's data rate is off, within ±10 %
        zero_length_probe: whether it acknowledges a write without data, as some adapters refuse to
        """
        self._clock = clock
        self._volts = volts
        self._faults = faults
        self._noise = noise
        self._zero_length_probe = zero_length_probe
        self._random = random.Random(seed)
        self.rate_factor = self._random.uniform(0.9, 1.1)
        self._lock = threading.RLock()
        self._last_codes: dict[int, int] = {}
        self.reset()
        faults.listen("brown-out", self.reset)
        faults.listen("unplugged", self.reset)

    @property
    def alert(self) -> bool:
        """Level of the ALERT/RDY pin with its pull-up; True is high."""
        with self._lock:
            now = self._catch_up()
            if not QUEUES[self._config & 3]:
                return True
            active_high = bool(self._config & 0x08)
            if not self._comparator.ready_pin:
                return self._comparator.asserted == active_high
            if self._config & _SINGLE_SHOT:
                return (self._conversion is None) == active_high
            return (0.0 <= now - self._completed < READY_PULSE) == active_high

    def reset(self) -> None:
        """Go back to the state after power-up; a conversion under way is lost."""
        with self._lock:
            self._pointer = CONVERSION
            self._config = RESET_CONFIG
            self._code = 0
            self._comparator = Comparator()
            self._conversion: _Conversion | None = None
            self._completed = -math.inf

    def general_call(self, data: bytes) -> None:
        """Reset on 06."""
        self._need_power()
        if data[:1] == b"\x06":
            self.reset()

    def write(self, data: bytes) -> None:
        """Take [pointer] or [pointer, high byte, low byte]; OSError EREMOTEIO: no ack."""
        self._need_power()
        if not data:
            if not self._zero_length_probe:
                raise kernel_error(errno.EREMOTEIO)
            return
        with self._lock:
            now = self._catch_up()
            self._pointer = data[0] & 3
            if len(data) >= 3:
                self._store(int.from_bytes(data[1:3], "big"), now)

    def read(self, length: int) -> bytes:
        """The register that the pointer points at, high byte first; more bytes read as FF."""
        self._need_power()
        with self._lock:
            self._catch_up()
            return (self._register().to_bytes(2, "big") + b"\xff" * length)[:length]

    def _need_power(self) -> None:
        if self._faults.active("unplugged"):
            raise kernel_error(errno.EREMOTEIO)

    def _register(self) -> int:
        if self._pointer == CONVERSION:
            self._comparator.result_read(self._config)
            return self._code & 0xFFFF
        if self._pointer == CONFIG:
            busy = self._conversion is not None or self._faults.active("stuck-busy")
            return self._config | (0 if busy else _IDLE_BIT)
        compare = self._comparator
        return (compare.low if self._pointer == LOW_THRESHOLD else compare.high) & 0xFFFF

    def _store(self, word: int, now: float) -> None:
        signed = word - 0x10000 if word & 0x8000 else word
        if self._pointer == LOW_THRESHOLD:
            self._comparator.low = signed
        elif self._pointer == HIGH_THRESHOLD:
            self._comparator.high = signed
        elif self._pointer == CONFIG:
            self._config = word & 0x7FFF
            wanted = word & _IDLE_BIT or not word & _SINGLE_SHOT
            # A chip that is busy ignores the start, but keeps the new config for the next one.
            if wanted and self._conversion is None and not self._faults.active("stuck-busy"):
                self._begin(now + POWER_UP)

    def _begin(self, start: float) -> None:
        rate = DATA_RATES[self._config >> 5 & 7] * self.rate_factor
        self._conversion = _Conversion(start, start + 1.0 / rate, self._config)

    def _catch_up(self) -> float:
        """Complete what should be complete by now; the time [s]."""
        now = self._clock.monotonic()
        if self._faults.active("stuck-busy"):
            return now
        while (current := self._conversion) is not None and current.end <= now:
            self._complete(current)
            self._conversion = None
            if not self._config & _SINGLE_SHOT:
                self._begin(current.end)
                self._skip(now)
        return now

    def _skip(self, now: float) -> None:
        """Leave out conversions of continuous mode that nobody has seen, save the last few."""
        if (current := self._conversion) is not None:
            period = current.end - current.start
            unseen = math.floor((now - current.start) / period) - _REMEMBERED
            if unseen > 0:
                self._begin(current.start + unseen * period)

    def _complete(self, conversion: _Conversion) -> None:
        start, end, config = conversion
        mux = config >> 12 & 7
        if self._faults.active("clipped"):
            code = 0x7FFF
        elif self._faults.active("frozen-code"):
            code = self._last_codes.get(mux, self._code)
        else:
            steps = self._volts(mux, start, end) / FULL_SCALE[config >> 9 & 7] * 0x8000
            noisy = self._random.gauss(steps, self._noise) if self._noise else steps
            code = round(min(max(noisy, -0x8000), 0x7FFF))
        self._code = self._last_codes[mux] = code
        self._completed = end
        self._comparator.compare(code, config)
