"""Time: the clocks, and the tickers that say when the next tick is due.

Deadlines are absolute, t0 + k·period, so nothing drifts. A late tick runs as soon as it can; slots
that have passed meanwhile are skipped and counted, and the phase is kept.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterator
from typing import Protocol

from msgspec import Struct

from fishd.timerfd import TimerFd


class Slot(Struct, frozen=True, gc=False):
    """One turn of the loop; times in seconds, monotonic."""

    index: int
    """Number of periods since the first slot, which is 0."""
    deadline: float
    """When the tick should begin."""
    now: float
    """When it does begin."""
    missed: int
    """Slots skipped just before this one."""


class Clock(Protocol):
    """Where time comes from."""

    def monotonic(self) -> float:
        """Time that never jumps [s]; for control."""

    def wall(self) -> float:
        """Unix time [s]; for people."""

    def sleep(self, seconds: float) -> None:
        """Let time pass."""


class SystemClock:
    """The machine's own clocks."""

    monotonic = staticmethod(time.monotonic)
    wall = staticmethod(time.time)
    sleep = staticmethod(time.sleep)


class VirtualClock:
    """Time that moves only when it is told to; it starts at zero."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        """Virtual time [s]."""
        return self.now

    def wall(self) -> float:
        """Virtual time [s], so that a run gives the same bytes whenever it is made."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Move on at once."""
        self.now += max(0.0, seconds)


class VirtualTicker:
    """Ticks of virtual time, never late; moves its clock."""

    def __init__(self, clock: VirtualClock, period: float) -> None:
        self._clock = clock
        self._period = period
        self._index = 0

    def __iter__(self) -> Iterator[Slot]:
        """Yield slots for ever; a second iteration goes on where the first one stopped."""
        while True:
            deadline = self._index * self._period
            self._clock.now = deadline
            yield Slot(self._index, deadline, deadline, 0)
            self._index += 1


class Ticker:
    """Ticks of real time for an asyncio loop.

    A timerfd wakes the asyncio loop a little early, and the rest is slept off with clock_nanosleep:
    so neither epoll's latency nor another task that was just running makes a tick late.
    """

    MARGIN = 2e-3
    """How long before the deadline to stop other work [s], at most a quarter of the period."""

    def __init__(self, period: float, rehearse: Callable[[], None] | None = None) -> None:
        """Must be made inside a running asyncio loop; the first slot is one period from now.

        rehearse: called just before each deadline, if there is time for it
        """
        self._period = period
        self._rehearse = rehearse
        self._margin = min(self.MARGIN, period / 4)
        self._rehearsal_time = self._margin / 2
        self._start = time.monotonic() + period
        self._index = -1
        self._timer = TimerFd()
        self._woken = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._timer, self._wake)

    def close(self) -> None:
        """Stop ticking; may be called twice."""
        if not self._timer.closed:
            self._loop.remove_reader(self._timer)
            self._timer.close()

    def __aiter__(self) -> "Ticker":
        return self

    async def __anext__(self) -> Slot:
        """Wait for the next slot; the caller is expected to tick at once."""
        following = self._index + 1
        self._woken.clear()
        self._timer.arm(self._start + following * self._period - self._margin)
        await self._woken.wait()
        deadline = self._start + following * self._period
        if self._rehearse:
            self._rehearse_before(deadline, self._rehearse)
        self._sleep_until(deadline)
        now = time.monotonic()
        current = max(following, math.floor((now - self._start) / self._period))
        self._index = current
        return Slot(current, self._start + current * self._period, now, current - following)

    def _wake(self) -> None:
        self._timer.clear()
        self._woken.set()

    def _rehearse_before(self, deadline: float, rehearse: Callable[[], None]) -> None:
        """Rehearse as late as is safe, then wait awake: a sleep would lose the caches again."""
        self._sleep_until(deadline - 2.0 * self._rehearsal_time)
        begun = time.monotonic()
        # One that took long, on a machine that was busy just then, must not end them for good.
        self._rehearsal_time *= 0.98
        if deadline - begun > self._rehearsal_time:
            rehearse()
            self._rehearsal_time = max(self._rehearsal_time, time.monotonic() - begun)
            while time.monotonic() < deadline:
                pass

    @staticmethod
    def _sleep_until(deadline: float) -> None:
        remaining = deadline - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)
