"""The folder of a sweep: what it was begun with, a table of its points, and their recordings."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from fishd import __version__
from fishd.core.errors import ConfigError, FishdError
from fishd.core.files import FileProblem, write_atomically
from fishd.lab import tables
from fishd.lab.begun import begin
from fishd.lab.sweep.grid import Point
from fishd.lab.sweep.results import Found, Quantity, quantity_of

BEGUN, POINTS, RECORDINGS = "sweep.json", "points.csv", "ticks"
RECORDING = "recording"
"""The column that names the recording of a point."""
_LONGEST = 256 * 2**20
"""Longest table of points [bytes]: 2.6 kB for each of the most that a grid has."""

On = Literal["simulation", "robot"]


class Begun(Struct, frozen=True):
    """What all points of a sweep have in common; a folder is resumed only with the same."""

    on: On
    config: dict[str, Any]
    """The fish, as plain data."""
    lengths: dict[str, float]
    """How long it swims at each point."""
    force_unit: str = "N"
    version: str = __version__

    @property
    def quantity(self) -> Quantity:
        """What is found at its points."""
        return quantity_of(self.on, self.config, self.force_unit)


class SweepFolder:
    """A folder in which points are kept as they are measured; `results` has them by their key."""

    def __init__(self, path: Path, begun: Begun, columns: Sequence[str]) -> None:
        """Makes the folder, or resumes one.

        columns: names of what differs from point to point, as in `Point.columns`
        Raises `ConfigError` where it is of another sweep.
        """
        self.path = path
        self.begun = begun
        self._columns = tuple(columns)
        self.results: dict[tuple[str, ...], Found] = {}
        try:
            begin(path / BEGUN, begun, "sweep")
            (path / RECORDINGS).mkdir(exist_ok=True)
            head = (*self._columns, *begun.quantity.measured, RECORDING)
            self._read(head)
            self._table = tables.Table(path / POINTS, head)
        except OSError as error:
            raise self._unwritable(error) from None

    def key(self, point: Point) -> tuple[str, ...]:
        """What tells a point from the others: its columns as text."""
        values = point.columns()
        return tuple(str(values.get(name, "")) for name in self._columns)

    def keep(self, point: Point, result: Found, recording: bytes | Path) -> None:
        """Keep what was measured, its recording first; raises `FishdError` when it cannot be.

        recording: its content, or a file in `RECORDINGS`
        """
        try:
            if isinstance(recording, bytes):
                path = self.recording_of(point)
                write_atomically(path, recording)
                recording = path
            key = self.key(point)
            values = msgspec.structs.asdict(result)
            row = dict(zip(self._columns, key, strict=True)) | values
            self._table.add(row | {RECORDING: f"{RECORDINGS}/{recording.name}"})
        except OSError as error:
            raise self._unwritable(error) from None
        self.results[key] = result

    def recording_of(self, point: Point) -> Path:
        """A free name for the recording of the next point."""
        number = len(self.results) + 1
        while any((self.path / RECORDINGS).glob(f"{number:04d}-*")):
            number += 1
        return self.path / RECORDINGS / f"{number:04d}-{point.controller}.mcap"

    def sort(self, found: Sequence[Point]) -> None:
        """Put the rows in the order of these points; others stay at the end."""
        head, *rows = self._rows()
        order = {self.key(point): index for index, point in enumerate(found)}
        width = len(self._columns)
        rows.sort(key=lambda row: order.get(tuple(row[:width]), len(order)))
        try:
            write_atomically(self.path / POINTS, tables.lines([head, *rows]))
        except OSError as error:
            raise self._unwritable(error) from None

    def _read(self, head: tuple[str, ...]) -> None:
        """The points that are there; a last row that a kill has cut off is dropped."""
        path = self.path / POINTS
        if not path.exists():
            return
        quantity = self.begun.quantity
        names = quantity.measured
        try:
            before, *rows = self._rows()
            if tuple(before) != head:
                raise ConfigError(f"{path}: {_other(before, names)}; give another --folder")
            complete = [row for row in rows if len(row) == len(head)]
            for row in complete:
                measured = dict(zip(head, row, strict=True))
                given = {name: measured[name] for name in names if measured[name]}
                self.results[tuple(row[: len(self._columns)])] = msgspec.convert(
                    given, quantity.result, strict=False
                )
        except ConfigError:
            raise
        except ValueError:
            raise ConfigError(
                f"{path}: not the table of a sweep; move it away, and its points are measured again"
            ) from None
        there = path.read_text(encoding="utf-8")
        plain = "".join(f"{','.join(row)}\n" for row in (head, *complete))  # soon, and mostly so
        if there != plain and there != (text := tables.lines([head, *complete])):
            write_atomically(path, text)

    def _rows(self) -> list[list[str]]:
        try:
            return tables.read(self.path / POINTS, _LONGEST)
        except FileProblem as problem:
            raise ConfigError(f"{self.path / POINTS}: {problem}") from None

    def _unwritable(self, error: OSError) -> FishdError:
        where = error.filename or self.path
        return FishdError(
            f"{where}: cannot be written: {error.strerror}; what was measured before is kept"
        )


def _other(head: Sequence[str], measured: tuple[str, ...]) -> str:
    """Why a table with another head is not resumed."""
    measured = (*measured, RECORDING)
    if tuple(head[-len(measured) :]) == measured:
        return (
            "this sweep has other parameters or keys: it was of "
            f"{', '.join(head[: -len(measured)])}"
        )
    missing = [name for name in measured if name not in head]
    why = f"it has no column {', '.join(missing)}" if missing else "it has other columns"
    return f"not a table as this fishd ({__version__}) writes it: {why}"
