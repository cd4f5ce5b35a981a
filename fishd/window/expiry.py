"""Clocks by which tokens expire: no wrong wall clock revives one or removes it from the file."""

import time
from functools import cache
from pathlib import Path

LOOK_PERIOD_S = 1.0
"""Time between two looks at the wall clock [s]."""
_TIMEX_BYTES = 512
"""Size that no `struct timex` of Linux exceeds [bytes]."""
_TIME_ERROR = 5
"""State of a clock that is not synchronised."""
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def boot_time() -> float:
    """Return the time since this machine has started, its sleep included [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@cache
def boot_id() -> str:
    """Return the name of this run of the machine, from which on `boot_time` counts."""
    return _BOOT_ID.read_text(encoding="ascii").strip()


def is_synchronised() -> bool:
    """Return whether a time server keeps the wall clock right; a step by hand ends that."""
    import ctypes

    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    return 0 <= int(state) < _TIME_ERROR


class SteadyClock:
    """Time of day that never goes back, and follows only a time server forward.

    A computer without a clock of its own begins in the past, until it finds a time server.
    """

    def __init__(self, earliest: float) -> None:
        """earliest: time before which it cannot be, whatever the wall clock shows [s, unix]"""
        self._start = max(time.time(), earliest) - boot_time()
        self._next_look = 0.0

    def now(self) -> float:
        """Return the time [s, unix]."""
        boot = boot_time()
        if boot >= self._next_look:
            self._next_look = boot + LOOK_PERIOD_S
            if (start := time.time() - boot) > self._start and is_synchronised():
                self._start = start
        return self._start + boot
