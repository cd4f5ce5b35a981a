"""Reads the two channels of the force sensor in turn, and goes on whatever the bus does.

X Y Y X X Y …: so the lag of the second sample of each pair cancels out in their mean.
"""

import math
from collections import deque
from typing import TYPE_CHECKING, Any, NamedTuple

from fishd.clock import Clock
from fishd.hardware.i2c_errors import explain
from fishd.hardware.packages import driver_packages
from fishd.hardware.settings import ForceSensorSettings

if TYPE_CHECKING:
    from fishd.hardware.single_shot import SingleShot

REMEMBERED = 4096
"""Pairs that are kept until somebody takes them; the oldest are dropped."""
FEW = 3
"""After so many failures in a row the bus is opened anew."""
LONGEST_PAUSE = 0.5
"""Between two attempts [s]."""


class Pair(NamedTuple):
    """Two samples, one right after the other."""

    begun: float
    """When the earlier one was asked for [s, monotonic]."""
    time: float
    """When the later one was complete."""
    x: int
    """Code of the ADC, -32768 to 32767."""
    y: int


class Sampler:
    """Owns the bus and the chip; only one thread may call it, save for what says otherwise."""

    def __init__(self, settings: ForceSensorSettings, clock: Clock) -> None:
        """Raises `MissingPackage` where the driver is not installed; opens nothing yet."""
        with driver_packages():
            from fishd.hardware import single_shot
        self._driver = single_shot
        self._settings = settings
        self._clock = clock
        self.pairs: deque[Pair] = deque(maxlen=REMEMBERED)
        """What came in, for another thread to take with `popleft`."""
        self.trouble = ""
        """Why the latest attempt failed, one line; empty if it did not. For any thread."""
        self.errors = 0
        """Attempts that failed, since start. For any thread."""
        self.reconnects = 0
        """How often the bus was opened anew and samples came again. For any thread."""
        self.ready_at = -math.inf
        """No conversion begins earlier [s, monotonic]: see `_recover`."""
        # A conversion goes on when the transfer that asks for it fails. While it does, the chip
        # ignores a start, and would answer with a sample of the other channel.
        self._settling = single_shot.TOO_SLOW / settings.data_rate + 1e-3
        self._duration = 1.0 / settings.data_rate
        self._failures = 0
        self._in_doubt = True
        self._y_first = False
        self._first: tuple[float, int] | None = None
        self._bus: Any = None
        self._chip: SingleShot
        self._x: Any
        self._y: Any

    def step(self) -> None:
        """Attempt one conversion; never raises. Takes as long as it takes, on its clock."""
        wait = self.ready_at - self._clock.monotonic()
        if wait > 0.0:
            self._clock.sleep(wait)
        try:
            if self._bus is None:
                self._open()
            if self._in_doubt:
                self._chip.check_idle()
                self._in_doubt = False
            self._convert()
        except Exception as error:  # the layers of drivers raise all kinds
            self._recover(error)
        else:
            self.reconnects += self._failures >= FEW
            self._failures = 0
            self.trouble = ""

    def close(self) -> None:
        """Let go of the bus; never raises, may be called twice."""
        bus, self._bus = self._bus, None
        if bus is not None:
            del self._chip, self._x, self._y
            self._driver.close_bus(bus)

    def _open(self) -> None:
        settings = self._settings
        bus = self._driver.open_bus(settings.bus)
        try:
            self._chip = self._driver.SingleShot(bus, settings, self._clock)
        except BaseException:
            self._driver.close_bus(bus)
            raise
        self._x = self._chip.input(settings.channel_x)
        self._y = self._chip.input(settings.channel_y)
        self._bus = bus

    def _convert(self) -> None:
        """Take the next sample, and with every second one complete a pair."""
        started = self._clock.monotonic()
        y_first = self._y_first
        if self._first is None:
            self._first = started, (self._y if y_first else self._x).value
            return
        begun, first = self._first
        second = (self._x if y_first else self._y).value
        x, y = (second, first) if y_first else (first, second)
        self.pairs.append(Pair(begun, started + self._duration, x, y))
        self._first = None
        self._y_first = not y_first

    def _recover(self, error: Exception) -> None:
        """Leave time for a conversion under way to end, and more after several failures."""
        self.trouble = explain(error, self._settings.bus, self._settings.address)
        self.errors += 1
        self._failures += 1
        self._first = None
        self._in_doubt = True
        pause = self._settling
        if self._failures >= FEW:
            self.close()
            pause = min(LONGEST_PAUSE, pause * 2.0 ** min(self._failures - FEW, 10))
        self.ready_at = self._clock.monotonic() + pause
