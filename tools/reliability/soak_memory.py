"""Check of a soak for leaks: of memory in long runs, of remaining objects per tick in all runs."""

import gc
import math
import sys
from pathlib import Path

from common.report import BrokenPromise

PAGE = 4096
MAX_GROWTH_MB = 1.0
"""Largest growth of memory [MB]."""
LEAK = 2.0
"""Remaining objects per tick, in both halves, that count as a leak; a record has more objects.

The history of the pulses and the caches of the plant are bounded, but still grow in a short run, by
about half an object per tick on a virtual Pi.
"""
LOOKS = (0.2, 0.6, 1.0)
"""Times of the measurements, as fractions of a run."""


class Memory:
    """Memory of this process at three times of a run."""

    def __init__(self, ticks: int, long_run: int) -> None:
        """`long_run`: number of ticks from which growth of memory is a leak and not the warm-up."""
        self._long = ticks >= long_run
        self._looks = {round(share * ticks): (0, 0) for share in LOOKS}

    def after(self, tick: int) -> None:
        """Record the memory; call it after every tick, counted from 1."""
        if tick not in self._looks:
            return
        gc.collect()
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
        self._looks[tick] = (sys.getallocatedblocks(), resident)

    def verdict(self, what: str) -> str:
        """Return a description of the growth; raises `BrokenPromise` for a leak."""
        (begin, middle, end), looks = self._looks, self._looks.values()
        blocks, resident = zip(*looks, strict=True)
        halves = (
            (blocks[1] - blocks[0]) / (middle - begin),
            (blocks[2] - blocks[1]) / (end - middle),
        )
        if min(halves) >= LEAK:
            raise BrokenPromise(f"{what}: {min(halves):.1f} objects are left behind per tick")
        growth = (resident[2] - resident[0]) / 1e6 if self._long else math.nan
        if growth >= MAX_GROWTH_MB:
            raise BrokenPromise(f"{what}: memory grew by {growth:.2f} MB")
        return f"memory {growth:+.2f} MB" if self._long else "no objects left behind"
