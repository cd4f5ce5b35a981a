"""Offset between two monotonic clocks, estimated from round trips.

The other program reads its clock at some time between request and reply. The middle of the two is
wrong by half of the round trip at most, so the shortest of several round trips gives the smallest
uncertainty (Cristian, "Probabilistic clock synchronization", Distributed Computing 3, 1989).
"""

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from fishd.client import Fish
from fishd.core.clock import read_boot_id
from fishd.core.errors import FishError

MAX_DRIFT = 1e-4
"""Largest relative drift between two clocks, twice that of crystal oscillators [s/s]."""
FIRST_ROUND_TRIPS = 8
"""Number of round trips of the first estimate."""
UPDATE_PERIOD_S = 5.0
"""Time between two later round trips [s]."""
MIN_UPDATE_TIMEOUT_S = 0.05
"""Smallest timeout of a later round trip; on a slow network it is four times the shortest one
[s]."""
RETRY_PERIOD_S = 1.0
"""Time between two attempts to restart the estimate [s]."""


class Reading(NamedTuple):
    """Reading of a program's clock."""

    clock: float
    """Time of the program's monotonic clock [s]."""
    boot: str
    """Identifier of the boot of its machine; see `fishd.core.clock.read_boot_id`."""


class Offset(NamedTuple):
    """Lead of the other program's clock over that of this machine."""

    seconds: float
    uncertainty: float
    """Largest error of `seconds` [s]."""


NO_OFFSET = Offset(0.0, 0.0)

Ask = Callable[[float | None], Reading]
"""Function that reads a program's clock; its argument is the timeout [s], None for its default."""


def clock_reader(fish: Fish) -> Ask:
    """Return a function that reads the clock of a fishd."""

    def ask(timeout: float | None) -> Reading:
        status = fish.status(timeout)
        return Reading(status.clock, status.boot_id)

    return ask


class _Exchange(NamedTuple):
    offset: float
    half_trip: float
    received: float


class ClockOffset:
    """Estimator of the lead of another program's clock.

    Only the first estimate waits for answers. Later updates keep the estimate where no answer comes
    at once, so `update` may be called within a tick.
    """

    def __init__(self, ask: Ask, now: Callable[[], float] = time.monotonic) -> None:
        """ask: reads the other program's clock, or raises an error; now: reads this clock [s]"""
        self._ask = ask
        self._now = now
        self._boot = read_boot_id()
        self._other_boot = ""
        self._exchanges: deque[_Exchange] = deque(maxlen=2 * FIRST_ROUND_TRIPS)
        self._last_request_time = 0.0
        self._shortest: float | None = None
        """Shortest of all round trips [s]."""
        self._failure: FishError | None = None
        """Error of the latest attempt to restart the estimate."""

    def update(self) -> Offset:
        """Return the offset, after another round trip when the latest one is old.

        Raises what `ask` raises before the first estimate.
        """
        if not self._exchanges:
            self._begin()
        elif not self._is_local and self._now() - self._last_request_time > UPDATE_PERIOD_S:
            with suppress(FishError):
                self._exchange()
                if len(self._exchanges) == 1:  # the machine is another one, or has rebooted
                    self._begin()
        return self.offset

    @property
    def has_answered(self) -> bool:
        """Whether there has ever been an answer."""
        return self._shortest is not None

    @property
    def _is_local(self) -> bool:
        """Whether the other program runs on this machine."""
        return bool(self._exchanges and self._other_boot) and self._other_boot == self._boot

    @property
    def offset(self) -> Offset:
        """Current estimate; exactly 0 for a program on this machine."""
        if self._is_local or not self._exchanges:
            return NO_OFFSET
        now = self._now()
        best = min(
            self._exchanges,
            key=lambda exchange: exchange.half_trip + MAX_DRIFT * (now - exchange.received),
        )
        return Offset(best.offset, best.half_trip + MAX_DRIFT * (now - best.received))

    def forget(self) -> None:
        """Reset the estimate: the other program has restarted, perhaps on another machine."""
        self._exchanges.clear()

    def _begin(self) -> None:
        """Make the first round trips; raises what `ask` raises where none succeeds."""
        if self._failure and self._now() - self._last_request_time < RETRY_PERIOD_S:
            raise self._failure.with_traceback(None)
        self._failure = None
        try:
            while len(self._exchanges) < FIRST_ROUND_TRIPS and not self._is_local:
                self._exchange()
        except FishError as error:
            if not self._exchanges:
                self._failure = error if self.has_answered else None
                raise

    def _exchange(self) -> None:
        timeout = (
            None if self._shortest is None else max(MIN_UPDATE_TIMEOUT_S, 4.0 * self._shortest)
        )
        sent = self._last_request_time = self._now()
        reading = self._ask(timeout)
        received = self._now()
        if reading.boot != self._other_boot:
            self.forget()
            self._other_boot = reading.boot
        self._shortest = min(received - sent, self._shortest or math.inf)
        half_trip = 0.5 * (received - sent)
        self._exchanges.append(_Exchange(reading.clock - (sent + half_trip), half_trip, received))
