"""Where the body was during a swim: its midline at the end of each tick."""

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.robot import Swimmer

PLACES = 81
"""Along the body, evenly from head to tail."""


class Midlines:
    """Midlines of a swim in the laboratory, 660 bytes each."""

    def __init__(self) -> None:
        self._time: list[float] = []
        self._lines: list[NDArray[np.float32]] = []

    def add(self, swimmer: Swimmer) -> None:
        """Add that of now."""
        fish = swimmer.fish
        line = fish.midline()
        wanted = np.linspace(0, len(line) - 1, PLACES)
        sparse = [np.interp(wanted, np.arange(len(line)), part) for part in line.T]
        self._time.append(fish.time)
        self._lines.append(
            np.stack([sparse[0] + fish.travelled, sparse[1]], axis=1).astype(np.float32)
        )

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """`midline_time`, of shape (n,) [s], and `midlines`, of shape (n, PLACES, 2) [m]."""
        time: Array = np.array(self._time, np.float64)
        lines = np.array(self._lines, np.float32).reshape(len(time), PLACES, 2)
        return {"midline_time": time, "midlines": lines}
