"""Track of a swim, with a row of numbers for each tick, and its files."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fishd.core.errors import ParameterError
from fishd.core.files import write_atomically

if TYPE_CHECKING:  # the columns are documented where numba is not installed
    from fishd.virtual.swimmer.fish import Work
    from fishd.virtual.swimmer.grid import Array
    from fishd.virtual.swimmer.robot import Swimmer

COLUMNS = {
    "time": ("s", "time of the fish at the end of the tick"),
    "x": ("m", "centre of mass, in the laboratory; it swims to −x"),
    "y": ("m", "centre of mass, in the laboratory"),
    "speed": ("m/s", "speed forwards, along −x"),
    "heading": ("rad", "angle of the front body to −x"),
    "tail_angle": (
        "rad",
        "angle of the rear body (last fifth), seen from the middle of the front body",
    ),
    "tail_rate": ("rad/s", "rate of tail_angle, not filtered"),
    "tail_lowest": ("m", "smallest y of the tip of the tail during the tick, in the laboratory"),
    "tail_highest": ("m", "largest y of the tip of the tail during the tick, in the laboratory"),
    "phi_c": ("rad", "instruction angle φ_c during the tick"),
    "activation": ("1", "activation a in the last step of the tick"),
    "thrust": ("N/m", "mean force of the water along −x"),
    "side_force": ("N/m", "mean force of the water along y"),
    "muscle_power": ("W/m", "mean power of the muscles; negative while they are stretched"),
    "water_power": ("W/m", "mean power of the body on the water"),
    "steering_power": ("W/m", "mean power of the steering torque"),
    "thrust_power": ("W/m", "mean power of the slices that push the fish forwards"),
    "lateral_power": ("W/m", "mean power of the body on the water along y"),
}
"""Unit and meaning of each column; forces and powers per metre of depth."""
MAX_FILE_BYTES = 2**30
"""Largest size of the file of a swim [bytes]."""
SUFFIXES = (".csv", ".npz")


class Track:
    """Rows of a swim, one per tick; all ticks have the same length."""

    def __init__(self, rows: "Array | None" = None) -> None:
        """rows: existing rows, shape (ticks, columns)"""
        self._rows: list[tuple[float, ...]] = [] if rows is None else list(map(tuple, rows))
        self._before: Work | None = None

    def __len__(self) -> int:
        return len(self._rows)

    def begin(self, swimmer: "Swimmer") -> None:
        """Start the powers with the work from now on."""
        self._before = swimmer.work

    def add(self, swimmer: "Swimmer", instruction_angle: float) -> None:
        """Add the latest tick; instruction_angle: the one during the tick [rad]."""
        motion, window, work = swimmer.motion, swimmer.window, swimmer.work
        before = self._before or work
        self._before = work
        lowest, highest = swimmer.tail_reach

        def power(current: float, earlier: float) -> float:
            return (current - earlier) / window.duration

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
            "phi_c": instruction_angle,
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
        """Return all rows, shape (ticks, columns)."""
        return np.array(self._rows, np.float64).reshape(len(self._rows), len(COLUMNS))

    def columns(self) -> "dict[str, Array]":
        """Return all columns by name, each of shape (ticks,)."""
        return dict(zip(COLUMNS, self.rows().T, strict=True))


def check_name(path: Path) -> None:
    """Raise `ParameterError` where no file of that name can be written."""
    if path.suffix not in SUFFIXES:
        raise ParameterError(f"{path}: a name that ends in {' or '.join(SUFFIXES)} is needed")
    if not path.parent.is_dir():
        raise ParameterError(f"{path}: there is no folder {path.parent}")


def save_table(track: Track, path: Path) -> None:
    """Write a CSV file with a header; raises OSError."""
    lines = [",".join(COLUMNS)]
    lines += [",".join(f"{value:.9g}" for value in row) for row in track.rows().tolist()]
    write_atomically(path, "\n".join(lines) + "\n")
