"""Tells whether a soak leaks: by memory in long runs, by objects left behind per tick in all."""

import gc
import math
import sys
from pathlib import Path

from common.report import BrokenPromise

PAGE = 4096
MOST = 1.0
"""Memory may grow by less than this [MB]."""
LEAK = 2.0
"""Objects left behind per tick, in both halves: a record with its numbers is more.

The history of the pulses and the caches of the plant, all of them bounded, still fill up in a short
run: about half an object per tick on a virtual Pi.
"""
LOOKS = (0.2, 0.6, 1.0)
"""When to look, as shares of a run."""


class Memory:
    """What this process has taken, at three times of a run."""

    def __init__(self, ticks: int, long_run: int) -> None:
        """`long_run`: from so many ticks on, the growth in MB is a leak and not the warm-up."""
        self._long = ticks >= long_run
        self._looks = {round(share * ticks): (0, 0) for share in LOOKS}

    def after(self, tick: int) -> None:
        """Call it after every tick, which are counted from 1."""
        if tick not in self._looks:
            return
        gc.collect()
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
        self._looks[tick] = (sys.getallocatedblocks(), resident)

    def verdict(self, what: str) -> str:
        """The growth in words; raises `BrokenPromise` where it is one that goes on for ever."""
        (begin, middle, end), looks = self._looks, self._looks.values()
        blocks, resident = zip(*looks, strict=True)
        halves = (
            (blocks[1] - blocks[0]) / (middle - begin),
            (blocks[2] - blocks[1]) / (end - middle),
        )
        if min(halves) >= LEAK:
            raise BrokenPromise(f"{what}: {min(halves):.1f} objects are left behind per tick")
        growth = (resident[2] - resident[0]) / 1e6 if self._long else math.nan
        if growth >= MOST:
            raise BrokenPromise(f"{what}: memory grew by {growth:.2f} MB")
        return f"memory {growth:+.2f} MB" if self._long else "no objects left behind"
