"""Where the body was during a swim: its midline at the end of each tick."""

import io
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fishd.core import files
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.robot import Swimmer
from fishd.virtual.swimmer.track import COLUMNS, LONGEST

PLACES = 81
"""Along the body, evenly from head to tail."""


class Midlines:
    """Midlines of a swim in the laboratory, 660 bytes each."""

    def __init__(self) -> None:
        self._time: list[float] = []
        self._lines: list[NDArray[np.float32]] = []

    def __len__(self) -> int:
        return len(self._time)

    @property
    def start(self) -> float:
        """Time of the first one; infinite while there are none [s]."""
        return self._time[0] if self._time else math.inf

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

    def put_before(self, path: Path, track: Array) -> None:
        """Put those before that a file has of the beginning of this swim, if it is of this swim.

        path: as `track.save` writes it; track: rows of the whole swim
        """
        rows = track[track[:, 0] < self.start]
        try:
            content = files.read(path, LONGEST, "a swim")
            with np.load(io.BytesIO(content), allow_pickle=False) as found:
                there = np.stack([found[name] for name in COLUMNS], axis=1)[: len(rows)]
                time, lines = found["midline_time"], found["midlines"]
        except Exception:  # NumPy and zipfile raise of all kinds for what is no archive of arrays
            return
        same = len(rows) and np.array_equal(there, rows)
        if same and lines.shape == (*time.shape, PLACES, 2):
            earlier = time < self.start
            self._time[:0] = time[earlier].tolist()
            self._lines[:0] = list(lines[earlier])

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """`midline_time`, of shape (n,) [s], and `midlines`, of shape (n, PLACES, 2) [m]."""
        time: Array = np.array(self._time, np.float64)
        lines = np.array(self._lines, np.float32).reshape(len(time), PLACES, 2)
        return {"midline_time": time, "midlines": lines}
