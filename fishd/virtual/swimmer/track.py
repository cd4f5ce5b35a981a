"""The track of a swim: a row of numbers for each tick, and files of it."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import ParameterError
from fishd.core.files import write_atomically

if TYPE_CHECKING:  # the columns are documented where numba is not installed
    from fishd.virtual.swimmer.fish import Work
    from fishd.virtual.swimmer.grid import Array
    from fishd.virtual.swimmer.robot import Swimmer

COLUMNS = {
    "time": ("s", "of the fish, at the end of the tick"),
    "x": ("m", "centre of mass, in the laboratory; it swims to −x"),
    "y": ("m", "centre of mass, in the laboratory"),
    "speed": ("m/s", "forwards, along −x"),
    "heading": ("rad", "of the front body against −x"),
    "tail_angle": ("rad", "of the rear body (last fifth), seen from the middle of the front body"),
    "tail_rate": ("rad/s", "its rate, not filtered"),
    "tail_lowest": ("m", "least y of the tip of the tail during the tick, in the laboratory"),
    "tail_highest": ("m", "the greatest"),
    "command": ("rad", "instruction angle φ_c during the tick"),
    "activation": ("1", "a, in the last step of the tick"),
    "thrust": ("N/m", "mean force of the water along −x"),
    "side_force": ("N/m", "mean force of the water along y"),
    "muscle_power": ("W/m", "of the muscles, mean; below 0 while they are stretched"),
    "water_power": ("W/m", "of the body on the water, mean"),
    "steering_power": ("W/m", "of the torque that keeps the fish on its way, mean"),
    "thrust_power": ("W/m", "of those slices that push the fish forwards, mean"),
    "lateral_power": ("W/m", "of the body on the water along y, mean"),
}
"""Unit and meaning of each column; forces and powers per metre of depth."""
LONGEST = 2**30
"""Of a file of a swim that is read [bytes]."""
SUFFIXES = (".csv", ".npz")


class Track:
    """Rows of a swim, one a tick, all ticks of the same length."""

    def __init__(self, rows: "Array | None" = None) -> None:
        """rows: those there are already, of shape (ticks, columns)"""
        self._rows: list[tuple[float, ...]] = [] if rows is None else list(map(tuple, rows))
        self._before: Work | None = None

    def __len__(self) -> int:
        return len(self._rows)

    def begin(self, swimmer: "Swimmer") -> None:
        """Powers are those of what is done from now on."""
        self._before = swimmer.work

    def add(self, swimmer: "Swimmer", command: float) -> None:
        """Add the tick that has just ended; command: φ_c meanwhile [rad]."""
        motion, window, work = swimmer.motion, swimmer.window, swimmer.work
        before = self._before or work
        self._before = work
        lowest, highest = swimmer.tail_reach

        def power(now: float, then: float) -> float:
            return (now - then) / window.duration

        row = {
            "time": motion.time,
            "x": motion.x,
            "y": motion.y,
            "speed": motion.speed,
            "heading": motion.heading,
            "tail_angle": motion.tail_angle,
            "tail_rate": motion.tail_rate,
            "tail_lowest": lowest,
            "tail_highest": highest,
            "command": command,
            "activation": swimmer.fish.activation,
            "thrust": window.thrust,
            "side_force": window.side_force,
            "muscle_power": power(work.muscles, before.muscles),
            "water_power": power(work.water, before.water),
            "steering_power": power(work.steering, before.steering),
            "thrust_power": power(work.forwards, before.forwards),
            "lateral_power": power(work.sideways, before.sideways),
        }
        self._rows.append(tuple(row[name] for name in COLUMNS))

    def rows(self) -> "Array":
        """All of them, of shape (ticks, columns)."""
        return np.array(self._rows, np.float64).reshape(len(self._rows), len(COLUMNS))

    def columns(self) -> "dict[str, Array]":
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
