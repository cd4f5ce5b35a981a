"""Faults of the virtual Pi, by name; they last for a given time or until they are cleared.

The emulated parts check whether a fault is active; an instantaneous fault calls its listeners.
"""

import errno
import math
import random
from collections.abc import Callable

from fishd.core.clock import Clock
from fishd.core.schema import suggest

FAULTS: dict[str, str] = {
    "nack": "I2C: no acknowledge (error 121)",
    "timeout": "I2C: the bus hangs until the kernel gives up (error 110)",
    "clock-stretch": "I2C: the clock is held low too long (error 5)",
    "bus-owned": "I2C: a kernel driver owns the address (error 16)",
    "arbitration-lost": "I2C: another master took the bus (error 11)",
    "unplugged": "ADS1115: no power or wires (error 121); returns after a reset",
    "stuck-busy": "ADS1115: a conversion never ends",
    "brown-out": "ADS1115: registers reset and conversion lost; happens at once",
    "frozen-code": "ADS1115: each input repeats its last code",
    "clipped": "ADS1115: every code is at full scale",
    "meter-unplugged": "INA219, INA226: no power or wires (error 121); returns after a reset",
    "meter-brown-out": "INA219, INA226: registers reset; happens at once",
    "pigpiod-gone": "pigpiod: not running; connections closed, pulses stopped, scripts lost",
    "pigpiod-frozen": "pigpiod: stopped; no answers, scripts pause, pulses continue",
    "pigpiod-old": "pigpiod: of a version that does not know PROCU, which a countdown needs",
    "pulse-jitter": "pigpiod: each edge of its pulses comes up to 100 µs late",
    "pigpiod-restart": "pigpiod: killed and started again; happens at once",
}
"""Names of the faults and their effects."""

INSTANTANEOUS = frozenset({"brown-out", "meter-brown-out", "pigpiod-restart"})
"""Faults without a duration, which only call their listeners."""

TRANSFER_ERRORS = {
    "nack": errno.EREMOTEIO,
    "timeout": errno.ETIMEDOUT,
    "clock-stretch": errno.EIO,
    "bus-owned": errno.EBUSY,
    "arbitration-lost": errno.EAGAIN,
}
"""Error number of the kernel for each fault that makes an I2C transfer fail."""


class Faults:
    """Faults of one virtual Pi; safe for use from several threads."""

    def __init__(self, clock: Clock, seed: int = 0) -> None:
        """`seed`: seed of the random errors of I2C transfers."""
        self._clock = clock
        self._until = dict.fromkeys(FAULTS, -math.inf)
        self._last_end = -math.inf
        """End of the latest fault [s]; a fast check at each of thousands of transfers."""
        self._listeners: dict[str, list[Callable[[], None]]] = {name: [] for name in FAULTS}
        self.error_rate = 0.0
        """Probability that an I2C transfer fails with a random error, 0 to 1."""
        self.random = random.Random(seed)

    def inject(self, name: str, seconds: float | None = None) -> None:
        """Start a fault, for `seconds` or until it is cleared.

        Raises ValueError for an unknown name, for seconds that are not positive, and for seconds of
        an instantaneous fault.
        """
        self._check(name)
        if seconds is not None and not 0.0 < seconds < math.inf:
            raise ValueError(f"{seconds:g} s of '{name}': a positive number is needed")
        if name not in INSTANTANEOUS:
            self._until[name] = math.inf if seconds is None else self._clock.monotonic() + seconds
            self._last_end = max(self._last_end, self._until[name])
        elif seconds is not None:
            raise ValueError(f"'{name}' happens at once and takes no seconds")
        for callback in tuple(self._listeners[name]):
            callback()

    def clear(self, name: str | None = None) -> None:
        """End one fault, or all and the random errors; raises ValueError for an unknown name."""
        if name is None:
            self._until.update(dict.fromkeys(FAULTS, -math.inf))
            self.error_rate = 0.0
        else:
            self._check(name)
            self._until[name] = -math.inf
        self._last_end = max(self._until.values())

    def active(self, name: str) -> bool:
        """Return whether a fault is active; raises KeyError for an unknown name."""
        until = self._until[name]
        return until > -math.inf and until > self._clock.monotonic()

    @property
    def none(self) -> bool:
        """Whether no fault can be active; faster than a check of each."""
        return self._last_end == -math.inf

    def listing(self) -> dict[str, float | None]:
        """Return the active faults and their remaining times [s]; None: until cleared."""
        now = self._clock.monotonic()
        return {
            name: None if until == math.inf else until - now
            for name, until in self._until.items()
            if until > now
        }

    def listen(self, name: str, callback: Callable[[], None]) -> None:
        """Register a callback for each injection of a fault; it runs in the injecting thread."""
        self._check(name)
        self._listeners[name].append(callback)

    def transfer_error(self) -> str | None:
        """Return the error of the next I2C transfer: an active fault, a random one, or None."""
        if not self.none:
            for name in TRANSFER_ERRORS:
                if self.active(name):
                    return name
        if self.error_rate and self.random.random() < self.error_rate:
            return self.random.choice(tuple(TRANSFER_ERRORS))
        return None

    @staticmethod
    def _check(name: str) -> None:
        if name not in FAULTS:
            raise ValueError(f"no fault is called '{name}'; {suggest(name, list(FAULTS))}")
