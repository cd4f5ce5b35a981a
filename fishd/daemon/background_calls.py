"""Calls in threads of their own: they load files, may never return, and hold up no tick."""

import asyncio
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from fishd.core.errors import Refused
from fishd.core.foreign_code import Attempt

T = TypeVar("T")

MOST_AT_ONCE = 4
"""Calls that may be under way, each in a thread of its own."""
MOST_GIVEN_UP = 8
"""Threads of calls that were given up and do not end; with more, no call begins."""


class BackgroundCalls:
    """Makes calls in threads, and gives up those that take too long.

    The interpreter does not wait for these threads when it ends, as it does for asyncio's own.
    """

    def __init__(self, patience: float) -> None:
        """patience: how long a call may take [s]"""
        self.patience = patience
        self._under_way = 0
        self._given_up: list[Attempt[Any]] = []

    def check_busy(self) -> None:
        """Raises `Refused` while too many calls are under way, or would not end."""
        if self._under_way >= MOST_AT_ONCE:
            raise Refused("busy", f"{self._under_way} requests are reading files; try again")
        self._given_up = [attempt for attempt in self._given_up if attempt.alive]
        if len(self._given_up) >= MOST_GIVEN_UP:
            raise Refused(
                "busy",
                f"{len(self._given_up)} calls that were given up, of controllers mostly, still "
                "run; restart fishd",
            )

    async def call(
        self,
        complaint: str,
        function: Callable[[], T],
        late: Callable[[T], Any] = lambda result: None,
        *,
        interrupt: bool = True,
    ) -> T:
        """What the function returns or raises.

        complaint: begins the message when it takes too long, such as `'chirp' has not loaded`
        late: takes the result of a call that returns after it was given up
        interrupt: as for `Attempt`
        Raises `Refused`: busy as `check_busy` says, too-slow for a call that takes too long. It is
        given up then, and likewise where this coroutine is cancelled.
        """
        self.check_busy()
        events = asyncio.get_running_loop()
        news = asyncio.Event()

        def done() -> None:
            with suppress(RuntimeError):  # the loop is closed: nobody waits any more
                events.call_soon_threadsafe(news.set)

        work = partial(_kept_running, function)
        attempt = Attempt(work, done=done, late=late, interrupt=interrupt)
        self._under_way += 1
        try:
            async with asyncio.timeout(self.patience):
                await news.wait()
        except TimeoutError:
            pass  # unless it is done just now
        finally:
            self._under_way -= 1
            if attempt.give_up():
                self._given_up.append(attempt)
        if not attempt.wait(0.0):
            raise Refused("too-slow", f"{complaint} within {self.patience:g} s; it is given up")
        return attempt.result()

    def dispose(self, function: Callable[[], Any]) -> None:
        """Make a call that nobody waits for, such as the `close` of an unused controller."""
        self._given_up.append(Attempt(function))


def _kept_running(function: Callable[[], T]) -> T:
    """Call it at the lowest FIFO priority, where the thread that ticks has a FIFO priority.

    A thread that holds the interpreter must not be preempted by ordinary programs: the tick would
    have to wait for it. On a single core the kernel's limit for real-time threads would hold up
    both, which is worse.
    """
    ticks = os.sched_getscheduler(os.getpid()) & ~os.SCHED_RESET_ON_FORK
    if ticks == os.SCHED_FIFO and len(os.sched_getaffinity(0)) > 1:
        with suppress(OSError):
            policy, lowest = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1)
            os.sched_setscheduler(0, policy, lowest)
    return function()
