"""Calls in separate threads: they may load files or never return, and delay no tick."""

import asyncio
import os
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from fishd.core.errors import Refused
from fishd.core.foreign_code import Attempt

T = TypeVar("T")

MAX_CALLS = 4
"""Largest number of calls that run at the same time, each in a separate thread."""
MAX_ABANDONED_CALLS = 8
"""Number of abandoned calls that still run, from which on no call is started."""


class BackgroundCalls:
    """Calls in threads, which are abandoned if they take too long.

    The interpreter does not wait for these threads when it ends, as it does for those of asyncio.
    """

    def __init__(self, timeout: float) -> None:
        """timeout: longest time of a call [s]"""
        self.timeout = timeout
        self._running = 0
        self._abandoned: list[Attempt[Any]] = []

    def check_busy(self) -> None:
        """Raise `Refused` while too many calls are running or do not end."""
        if self._running >= MAX_CALLS:
            raise Refused("busy", f"{self._running} requests are reading files; try again")
        self._abandoned = [attempt for attempt in self._abandoned if attempt.alive]
        if len(self._abandoned) >= MAX_ABANDONED_CALLS:
            raise Refused(
                "busy",
                f"{len(self._abandoned)} abandoned calls, mostly of controllers, still run; "
                "restart fishd",
            )

    async def call(
        self,
        complaint: str,
        function: Callable[[], T],
        late: Callable[[T], Any] = lambda result: None,
    ) -> T:
        """Call a function in a thread; return what it returns, or raise what it raises.

        complaint: start of the message if it takes too long, such as `'chirp' has not loaded`
        late: function that takes the result of an abandoned call that returns after all
        Raises `Refused`: busy as in `check_busy`, too-slow for a call that takes too long. Such a
        call is abandoned, and so is a call whose coroutine is cancelled.
        """
        self.check_busy()
        events = asyncio.get_running_loop()
        is_done = asyncio.Event()

        def done() -> None:
            with suppress(RuntimeError):  # the asyncio loop is closed
                events.call_soon_threadsafe(is_done.set)

        work = partial(_run_with_priority, function)
        attempt = Attempt(work, done=done, late=late)
        self._running += 1
        try:
            async with asyncio.timeout(self.timeout):
                await is_done.wait()
        except TimeoutError:
            pass  # the call may still end just now
        finally:
            self._running -= 1
            if attempt.give_up():
                self._abandoned.append(attempt)
        if not attempt.wait(0.0):
            raise Refused(
                "too-slow", f"{complaint} within {self.timeout:g} s; the call is abandoned"
            )
        return attempt.result()

    def dispose(self, function: Callable[[], Any]) -> None:
        """Start a call without waiting for it, such as the `close` of an unused controller."""
        self._abandoned.append(Attempt(function))


def _run_with_priority(function: Callable[[], T]) -> T:
    """Call a function at the lowest FIFO priority if the thread that ticks has a FIFO priority.

    A thread that holds the interpreter must not be preempted by ordinary programs, because the tick
    would have to wait for it. On a single core the priority stays normal: the kernel's limit for
    real-time threads would delay both, which is worse.
    """
    policy_of_ticks = os.sched_getscheduler(os.getpid()) & ~os.SCHED_RESET_ON_FORK
    if policy_of_ticks == os.SCHED_FIFO and len(os.sched_getaffinity(0)) > 1:
        with suppress(OSError):
            policy, lowest = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1)
            os.sched_setscheduler(0, policy, lowest)
    return function()
