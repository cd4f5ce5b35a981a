"""The offset between two monotonic clocks, estimated from round trips.

The answer was given at some time between question and answer. Taken as the middle, it is wrong by
half of the round trip at most; so the shortest of several tells most (Cristian, "Probabilistic
clock synchronization", Distributed Computing 3, 1989).
"""

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from fishd.client import Fish
from fishd.core.clock import boot_id
from fishd.core.errors import FishError

DRIFT = 1e-4
"""By so much two clocks may run apart: twice what crystals do [s/s]."""
ROUNDS = 8
"""Round trips for a first estimate."""
AGAIN = 5.0
"""Time between two further ones [s]."""
QUICK = 0.05
"""How long a further one may take at least; a slow network gets four times its best [s]."""
PAUSE = 1.0
"""Time between two tries to begin anew [s]."""


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

Ask = Callable[[float | None], Reading]
"""Asks a program for its clock, and waits so long [s]; None: as long as it likes."""


def clock_of(fish: Fish) -> Ask:
    """Asks a fishd."""

    def ask(patience: float | None) -> Reading:
        status = fish.status(patience)
        return Reading(status.clock, status.boot)

    return ask


class _Exchange(NamedTuple):
    offset: float
    half: float
    when: float


class ClockOffset:
    """Asks for the time of another program, and knows how far its clock is ahead.

    It waits for an answer only until the first one has come; later it keeps what it knows where
    none comes at once, so that it may be asked within a tick.
    """

    def __init__(self, ask: Ask, now: Callable[[], float] = time.monotonic) -> None:
        """ask: gives the other program's clock, or raises what it likes; now: this one [s]"""
        self._ask = ask
        self._now = now
        self._boot = boot_id()
        self._theirs = ""
        self._exchanges: deque[_Exchange] = deque(maxlen=2 * ROUNDS)
        self._asked = 0.0
        self._shortest: float | None = None
        """Of all round trips so far [s]."""
        self._failure: FishError | None = None
        """Why it could not begin anew."""

    def update(self) -> Offset:
        """The offset; asks once more when the latest answer is old.

        Raises what `ask` raises as long as nothing is known.
        """
        if not self._exchanges:
            self._begin()
        elif not self._same and self._now() - self._asked > AGAIN:
            with suppress(FishError):
                self._exchange()
                if len(self._exchanges) == 1:  # another machine, or another start of it
                    self._begin()
        return self.offset

    @property
    def known(self) -> bool:
        """Has it ever had an answer?"""
        return self._shortest is not None

    @property
    def _same(self) -> bool:
        """Is it a program on this machine?"""
        return bool(self._exchanges and self._theirs) and self._theirs == self._boot

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

    def _begin(self) -> None:
        """Exchange until the offset is known well; raises what `ask` raises where it is not."""
        if self._failure and self._now() - self._asked < PAUSE:
            raise self._failure.with_traceback(None)
        self._failure = None
        try:
            while len(self._exchanges) < ROUNDS and not self._same:
                self._exchange()
        except FishError as error:
            if not self._exchanges:
                self._failure = error if self.known else None
                raise

    def _exchange(self) -> None:
        patience = None if self._shortest is None else max(QUICK, 4.0 * self._shortest)
        sent = self._asked = self._now()
        reading = self._ask(patience)
        received = self._now()
        if reading.boot != self._theirs:
            self.forget()
            self._theirs = reading.boot
        self._shortest = min(received - sent, self._shortest or math.inf)
        half = 0.5 * (received - sent)
        self._exchanges.append(_Exchange(reading.clock - (sent + half), half, received))
