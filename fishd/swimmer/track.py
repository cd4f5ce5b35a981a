"""The track of a swim: a row of numbers for each tick, and files of it."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import ParameterError
from fishd.core.files import write_atomically
from fishd.swimmer.fish import Work
from fishd.swimmer.grid import Array
from fishd.swimmer.robot import Swimmer

COLUMNS = {
    "time": ("s", "of the fish, at the end of the tick"),
    "x": ("m", "centre of mass, in the laboratory; it swims to −x"),
    "y": ("m", "centre of mass, in the laboratory"),
    "speed": ("m/s", "forwards, along −x"),
    "heading": ("rad", "of the front body against −x"),
    "tail_angle": ("rad", "of the tip of the tail, seen from the middle of the front body"),
    "tail_rate": ("rad/s", "its rate, not filtered"),
    "tail_lowest": ("m", "least y of the tip of the tail during the tick, in the laboratory"),
    "tail_highest": ("m", "the greatest"),
    "command": ("rad", "instruction angle φ_c during the tick"),
    "activation": ("1", "a, in the last step of the tick"),
    "thrust": ("N/m", "mean force of the water along −x"),
    "side_force": ("N/m", "mean force of the water along y"),
    "muscle_power": ("W/m", "of the muscles, mean"),
    "water_power": ("W/m", "of the body on the water, mean"),
    "thrust_power": ("W/m", "of what pushes the fish forwards, mean"),
    "lateral_power": ("W/m", "of the body on the water along y, mean"),
}
"""Unit and meaning of each column; forces and powers per metre of depth."""
SUFFIXES = (".csv", ".npz")


class Track:
    """Rows of a swim, one a tick, all ticks of the same length."""

    def __init__(self, rows: Array | None = None) -> None:
        """rows: those there are already, of shape (ticks, columns)"""
        self._rows: list[tuple[float, ...]] = [] if rows is None else list(map(tuple, rows))
        self._before = Work(0.0, 0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self._rows)

    def begin(self, swimmer: Swimmer) -> None:
        """Powers are those of what is done from now on."""
        self._before = swimmer.work

    def add(self, swimmer: Swimmer, command: float) -> None:
        """Add the tick that has just ended; command: φ_c meanwhile [rad]."""
        motion, window, work = swimmer.motion, swimmer.window, swimmer.work
        powers = [
            (now - then) / window.duration for now, then in zip(work, self._before, strict=True)
        ]
        self._before = work
        self._rows.append(
            (
                motion.time,
                motion.x,
                motion.y,
                motion.speed,
                motion.heading,
                motion.tail_angle,
                motion.tail_rate,
                *swimmer.tail_reach,
                command,
                swimmer.fish.activation,
                window.thrust,
                window.side_force,
                *powers,
            )
        )

    def rows(self) -> Array:
        """All of them, of shape (ticks, columns)."""
        return np.array(self._rows, np.float64).reshape(len(self._rows), len(COLUMNS))

    def columns(self) -> dict[str, Array]:
        """The same by name, each of shape (ticks,)."""
        return dict(zip(COLUMNS, self.rows().T, strict=True))


def check_name(path: Path) -> None:
    """Raises `ParameterError` where no file of that name can be written."""
    if path.suffix not in SUFFIXES:
        raise ParameterError(f"{path}: a name that ends in {' or '.join(SUFFIXES)} is needed")
    if not path.parent.is_dir():
        raise ParameterError(f"{path}: there is no folder {path.parent}")


def save(
    track: Track, path: Path, others: Mapping[str, NDArray[np.floating]] | None = None
) -> None:
    """Write a CSV file with a header, or an NPZ file with an array for each column.

    others: arrays that go into an NPZ file, too
    Raises OSError.
    """
    if path.suffix == ".csv":
        lines = [",".join(COLUMNS)]
        lines += [",".join(f"{value:.9g}" for value in row) for row in track.rows().tolist()]
        write_atomically(path, "\n".join(lines) + "\n")
        return
    content, arrays = io.BytesIO(), cast(dict[str, Any], track.columns() | dict(others or {}))
    np.savez_compressed(content, **arrays)
    write_atomically(path, content.getvalue())
