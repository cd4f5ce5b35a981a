"""The offset between two monotonic clocks, estimated from round trips.

The answer was given at some time between question and answer. Taken as the middle, it is wrong by
half of the round trip at most; so the shortest of several tells most (Cristian, "Probabilistic
clock synchronization", Distributed Computing 3, 1989).
"""

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from fishd.core.clock import boot_id
from fishd.core.errors import FishError

DRIFT = 1e-4
"""By so much two clocks may run apart: twice what crystals do [s/s]."""
ROUNDS = 8
"""Round trips for a first estimate."""
AGAIN = 5.0
"""Time between two further ones [s]."""


class Reading(NamedTuple):
    """What a program says of its clock."""

    clock: float
    """[s]"""
    boot: str
    """Names the start of its machine; see `fishd.core.clock.boot_id`."""


class Offset(NamedTuple):
    """How far their clock is ahead of that of this machine."""

    seconds: float
    uncertainty: float
    """It is wrong by no more [s]."""


SAME = Offset(0.0, 0.0)


class _Exchange(NamedTuple):
    offset: float
    half: float
    when: float


class ClockOffset:
    """Asks for the time of another program, and knows how far its clock is ahead."""

    def __init__(
        self, ask: Callable[[], Reading], now: Callable[[], float] = time.monotonic
    ) -> None:
        """ask: gives the other program's clock, or raises what it likes; now: this one [s]"""
        self._ask = ask
        self._now = now
        self._boot = boot_id()
        self._same = False
        self._exchanges: deque[_Exchange] = deque(maxlen=2 * ROUNDS)
        self._asked = 0.0

    def update(self) -> Offset:
        """The offset; asks once more when the latest answer is old.

        Raises what `ask` raises as long as nothing is known.
        """
        if not self._exchanges:
            for _ in range(ROUNDS):
                self._exchange()
                if self._same:
                    break
        elif not self._same and self._now() - self._asked > AGAIN:
            with suppress(FishError):
                self._exchange()
        return self.offset

    @property
    def offset(self) -> Offset:
        """As far as it is known; exactly 0 for a program on this machine."""
        if self._same or not self._exchanges:
            return SAME
        now = self._now()
        best = min(self._exchanges, key=lambda each: each.half + DRIFT * (now - each.when))
        return Offset(best.offset, best.half + DRIFT * (now - best.when))

    def forget(self) -> None:
        """Begin anew: the other program was started again, perhaps on another machine."""
        self._exchanges.clear()
        self._same = False

    def _exchange(self) -> None:
        sent = self._asked = self._now()
        reading = self._ask()
        received = self._now()
        self._same = not reading.boot or reading.boot == self._boot
        half = 0.5 * (received - sent)
        self._exchanges.append(_Exchange(reading.clock - (sent + half), half, received))
