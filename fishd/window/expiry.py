"""Clocks by which tokens expire: a step of the wall clock neither revives nor ends one."""

import time
from functools import cache
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def boot_time() -> float:
    """Return the time since this machine has started, its sleep included [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@cache
def boot_id() -> str:
    """Return the name of this run of the machine, from which on `boot_time` counts."""
    return _BOOT_ID.read_text(encoding="ascii").strip()


class SteadyClock:
    """Time of day that is set once, and then follows no step of the wall clock."""

    def __init__(self, earliest: float) -> None:
        """earliest: time before which it cannot be, whatever the wall clock shows [s, unix]"""
        self._start = max(time.time(), earliest) - boot_time()

    def now(self) -> float:
        """Return the time [s, unix]."""
        return self._start + boot_time()
