"""Time: clocks, a timer of the kernel, and tickers that wait until the next tick is due.

Deadlines are absolute, t0 + k·period, so nothing drifts. A late tick runs as soon as it can; slots
that have passed by then are skipped and counted, and the phase is kept.
"""

import ctypes
import itertools
import math
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from msgspec import Struct


class Slot(Struct, frozen=True, gc=False):
    """One turn of the loop; times in seconds, monotonic."""

    index: int
    """Number of periods since the first slot, which has index 0."""
    deadline: float
    """Time at which the tick should begin."""
    now: float
    """Time at which the tick begins."""
    missed: int
    """Number of slots skipped just before this one."""


class Clock(Protocol):
    """A source of time."""

    def monotonic(self) -> float:
        """Return a time that never jumps [s]; for control."""

    def wall(self) -> float:
        """Return the unix time [s]; for display."""

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s]."""


class SystemClock:
    """The clocks of the machine."""

    monotonic = staticmethod(time.monotonic)
    wall = staticmethod(time.time)
    sleep = staticmethod(time.sleep)


def read_boot_id() -> str:
    """Return the name of this boot, from which the monotonic clock counts; empty if unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


class VirtualClock:
    """Clock that advances only when the program sets it or sleeps; it starts at zero."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        """Return the virtual time [s]."""
        return self.now

    def wall(self) -> float:
        """Return the virtual time [s], so that each run gives the same bytes."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Advance the clock at once."""
        self.now += max(0.0, seconds)


class SlowClock(VirtualClock):
    """Virtual clock for runs that a person watches: its unix time is that of the machine."""

    wall = staticmethod(time.time)


def virtual_slots(clock: VirtualClock, period: float) -> Iterator[Slot]:
    """Yield slots of virtual time without end, never late, and advance the clock. period: [s]"""
    for index in itertools.count():
        clock.now = index * period
        yield Slot(index, clock.now, clock.now, 0)


_CLOCK_MONOTONIC = 1
_ABSOLUTE = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


_libc = ctypes.CDLL(None, use_errno=True)


def _check_result(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


class TimerFd:
    """One-shot timer on CLOCK_MONOTONIC whose descriptor an event loop can wait for.

    Python has os.timerfd_create only from 3.13 on; the C library always has it. Raises OSError
    if the kernel refuses.
    """

    def __init__(self) -> None:
        self._fd = _check_result(
            _libc.timerfd_create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        )
        self._spec = _Itimerspec()

    def fileno(self) -> int:
        """Return the descriptor, which is readable once the timer has expired."""
        return self._fd

    def arm(self, deadline: float) -> None:
        """Set the timer to expire at `deadline` [s, monotonic]; at once if that has passed."""
        seconds = int(deadline)
        value = self._spec.value
        value.seconds = seconds
        value.nanoseconds = max(1, int((deadline - seconds) * 1e9))  # all zero would disarm
        _check_result(_libc.timerfd_settime(self._fd, _ABSOLUTE, ctypes.byref(self._spec), None))

    def clear(self) -> None:
        """Make the descriptor unreadable again."""
        with suppress(BlockingIOError):
            os.read(self._fd, 8)

    @property
    def closed(self) -> bool:
        """True after close()."""
        return self._fd < 0

    def close(self) -> None:
        """Close the descriptor; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class Ticker:
    """Ticks of real time for an asyncio loop.

    A timerfd wakes the asyncio loop a little early, and clock_nanosleep waits for the rest, so that
    neither epoll's latency nor another running task makes a tick late.
    """

    MARGIN_S = 2e-3
    """Time before the deadline at which other work stops, at most a quarter of the period [s]."""
    EARLY_S = 6e-5
    """Time before the deadline at which the last sleep ends, because a wake-up takes about as long
    [s]; the rest is a busy-wait."""

    def __init__(self, period: float) -> None:
        """Start the ticker inside a running asyncio loop; the first slot is two margins from now.

        period: [s]
        """
        import asyncio  # slow to import: a tenth of the start of programs that use only the clocks

        self._period = period
        self._margin = min(self.MARGIN_S, period / 4)
        self._start = time.monotonic() + 2.0 * self._margin
        self._index = -1
        self._timer = TimerFd()
        self._loop = asyncio.get_running_loop()
        self._woken = self._loop.create_future()
        self._loop.add_reader(self._timer, self._wake)

    def close(self) -> None:
        """Stop ticking; may be called twice."""
        if not self._timer.closed:
            self._loop.remove_reader(self._timer)
            self._timer.close()

    def __aiter__(self) -> "Ticker":
        return self

    async def __anext__(self) -> Slot:
        """Wait for the next slot, in which the caller must tick at once."""
        following = self._index + 1
        deadline = self._start + following * self._period
        self._woken = self._loop.create_future()
        self._timer.arm(deadline - self._margin)
        await self._woken
        remaining = deadline - time.monotonic() - self.EARLY_S
        if remaining > 0.0:
            time.sleep(remaining)
        while (now := time.monotonic()) < deadline:
            pass
        current = max(following, math.floor((now - self._start) / self._period))
        self._index = current
        return Slot(current, self._start + current * self._period, now, current - following)

    def _wake(self) -> None:
        self._timer.clear()
        if not self._woken.done():
            self._woken.set_result(None)
