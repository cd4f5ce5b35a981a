"""Midlines of the body during a swim, at the end of each tick."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.robot import Swimmer

Line = NDArray[np.float32]
POINT_COUNT = 81
"""Number of equally spaced points of a midline, from head to tail."""


class Midlines:
    """Midlines of a swim in the laboratory, 660 bytes each."""

    def __init__(self, time: Sequence[float] = (), lines: Sequence[Line] = ()) -> None:
        """time: of existing midlines [s]; lines: shape (n, POINT_COUNT, 2) [m]"""
        self._time, self._lines = list(time), list(lines)

    def add(self, swimmer: Swimmer) -> None:
        """Add the current midline."""
        fish = swimmer.fish
        line = fish.midline()
        indices = np.linspace(0, len(line) - 1, POINT_COUNT)
        sparse = [np.interp(indices, np.arange(len(line)), part) for part in line.T]
        self._time.append(fish.time)
        self._lines.append((np.stack(sparse, axis=1) + fish.travelled).astype(np.float32))

    def arrays(self) -> tuple[Array, NDArray[np.float32]]:
        """Return times, shape (n,) [s], and midlines, shape (n, POINT_COUNT, 2) [m]."""
        time: Array = np.array(self._time, np.float64)
        lines = np.array(self._lines, np.float32).reshape(len(time), POINT_COUNT, 2)
        return time, lines
