"""What can go wrong with the virtual Pi: faults by name, injected for a while or until cleared.

The emulated parts ask whether a fault is active; one that happens at once calls its listeners.
"""

import errno
import math
import random
from collections.abc import Callable

from fishd.core.clock import Clock
from fishd.core.schema import suggest

FAULTS: dict[str, str] = {
    "nack": "I2C: nobody acknowledges (error 121)",
    "timeout": "I2C: the bus hangs until the kernel gives up (error 110)",
    "clock-stretch": "I2C: the clock is held too long (error 5)",
    "bus-owned": "I2C: a kernel driver owns the address (error 16)",
    "arbitration-lost": "I2C: another master took the bus (error 11)",
    "unplugged": "ADS1115: without power or wires (error 121); back with its registers at reset",
    "stuck-busy": "ADS1115: a conversion never ends",
    "brown-out": "ADS1115: registers reset and conversion lost; happens at once",
    "frozen-code": "ADS1115: each input repeats its last code",
    "clipped": "ADS1115: every code is at full scale",
    "meter-unplugged": "INA219, INA226: without power or wires (error 121); back at reset",
    "meter-brown-out": "INA219, INA226: registers reset; happens at once",
    "pigpiod-gone": "pigpiod: dead; connections closed, pulses stopped, scripts lost",
    "pigpiod-frozen": "pigpiod: stopped; answers nothing, scripts stand still, pulses go on",
    "pigpiod-restart": "pigpiod: killed and started again; happens at once",
}
"""Every fault and what it does."""

INSTANTANEOUS = frozenset({"brown-out", "meter-brown-out", "pigpiod-restart"})
"""Faults that happen at once: they have listeners, but no duration."""

TRANSFER_ERRORS = {
    "nack": errno.EREMOTEIO,
    "timeout": errno.ETIMEDOUT,
    "clock-stretch": errno.EIO,
    "bus-owned": errno.EBUSY,
    "arbitration-lost": errno.EAGAIN,
}
"""Faults that make an I2C transfer fail, with the error numbers that the kernel gives."""


class Faults:
    """The faults of one virtual Pi; safe to use from several threads."""

    def __init__(self, clock: Clock, seed: int = 0) -> None:
        """`seed`: of the random errors of I2C transfers."""
        self._clock = clock
        self._until = dict.fromkeys(FAULTS, -math.inf)
        self._latest = -math.inf
        """When the last of them ends; asked at each transfer, of which there are thousands [s]."""
        self._listeners: dict[str, list[Callable[[], None]]] = {name: [] for name in FAULTS}
        self.error_rate = 0.0
        """Share of the I2C transfers that fail with an error chosen at random, 0 to 1."""
        self.random = random.Random(seed)

    def inject(self, name: str, seconds: float | None = None) -> None:
        """Let a fault begin, for `seconds` or until it is cleared.

        Raises ValueError for an unknown name, for seconds that are not positive, and for seconds of
        a fault that happens at once.
        """
        self._check(name)
        if seconds is not None and not 0.0 < seconds < math.inf:
            raise ValueError(f"{seconds:g} s of '{name}': a positive number is needed")
        if name not in INSTANTANEOUS:
            self._until[name] = math.inf if seconds is None else self._clock.monotonic() + seconds
            self._latest = max(self._latest, self._until[name])
        elif seconds is not None:
            raise ValueError(f"'{name}' happens at once and takes no seconds")
        for callback in tuple(self._listeners[name]):
            callback()

    def clear(self, name: str | None = None) -> None:
        """End one fault, or all of them and the random errors too; ValueError: unknown name."""
        if name is None:
            self._until.update(dict.fromkeys(FAULTS, -math.inf))
            self.error_rate = 0.0
        else:
            self._check(name)
            self._until[name] = -math.inf
        self._latest = max(self._until.values())

    def active(self, name: str) -> bool:
        """True while the fault lasts; KeyError for an unknown name."""
        until = self._until[name]
        return until > -math.inf and until > self._clock.monotonic()

    @property
    def none(self) -> bool:
        """True while no fault can be active: quicker than to ask for each."""
        return self._latest == -math.inf

    def listing(self) -> dict[str, float | None]:
        """The active faults and the seconds that each has left; None: until it is cleared."""
        now = self._clock.monotonic()
        return {
            name: None if until == math.inf else until - now
            for name, until in self._until.items()
            if until > now
        }

    def listen(self, name: str, callback: Callable[[], None]) -> None:
        """Have `callback` called at each injection of the fault, in the thread that injects it."""
        self._check(name)
        self._listeners[name].append(callback)

    def transfer_error(self) -> str | None:
        """The error that the next I2C transfer meets: one that is active, or a random one."""
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
