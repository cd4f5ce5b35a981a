"""Midlines of the body during a swim, at the end of each tick."""

import io
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fishd.core import files
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.robot import Swimmer
from fishd.virtual.swimmer.track import COLUMNS, MAX_FILE_BYTES

POINT_COUNT = 81
"""Number of equally spaced points of a midline, from head to tail."""


class Midlines:
    """Midlines of a swim in the laboratory, 660 bytes each."""

    def __init__(self) -> None:
        self._time: list[float] = []
        self._lines: list[NDArray[np.float32]] = []

    def __len__(self) -> int:
        return len(self._time)

    @property
    def start(self) -> float:
        """Time of the first midline [s]; infinite without midlines."""
        return self._time[0] if self._time else math.inf

    def add(self, swimmer: Swimmer) -> None:
        """Add the current midline."""
        fish = swimmer.fish
        line = fish.midline()
        indices = np.linspace(0, len(line) - 1, POINT_COUNT)
        sparse = [np.interp(indices, np.arange(len(line)), part) for part in line.T]
        self._time.append(fish.time)
        self._lines.append(
            np.stack([sparse[0] + fish.travelled, sparse[1]], axis=1).astype(np.float32)
        )

    def put_before(self, path: Path, track: Array) -> None:
        """Prepend the midlines in a file, if it contains the beginning of this swim.

        path: file that `track.save` has written; track: rows of the whole swim
        """
        rows = track[track[:, 0] < self.start]
        try:
            content = files.read(path, MAX_FILE_BYTES, "a swim")
            with np.load(io.BytesIO(content), allow_pickle=False) as npz:
                stored_rows = np.stack([npz[name] for name in COLUMNS], axis=1)[: len(rows)]
                time, lines = npz["midline_time"], npz["midlines"]
        except Exception:  # NumPy and zipfile raise many kinds of errors for other files
            return
        same = len(rows) and np.array_equal(stored_rows, rows)
        if same and lines.shape == (*time.shape, POINT_COUNT, 2):
            earlier = time < self.start
            self._time[:0] = time[earlier].tolist()
            self._lines[:0] = list(lines[earlier])

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """Return `midline_time`, shape (n,) [s], and `midlines`, shape (n, POINT_COUNT, 2) [m]."""
        time: Array = np.array(self._time, np.float64)
        lines = np.array(self._lines, np.float32).reshape(len(time), POINT_COUNT, 2)
        return {"midline_time": time, "midlines": lines}
