"""Folder of a sweep: the results by point, in the table of the experiment, and the recordings."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from fishd.core.errors import ConfigError
from fishd.lab.experiment import ROWS, Experiment
from fishd.lab.sweep.grid import Point
from fishd.lab.sweep.results import PointResult, select_quantity

RECORDINGS_FOLDER = "ticks"
RECORDING_COLUMN = "recording"
"""Name of the column with the path of a point's recording."""


class SweepFolder:
    """Results of a sweep, written to its folder one by one; `results` holds them by key."""

    def __init__(self, experiment: Experiment, columns: Sequence[str]) -> None:
        """
        columns: names of the columns that differ between points, as in `Point.columns`

        Raises `ConfigError` if the table belongs to another sweep.
        """
        header = experiment.header
        self.experiment = experiment
        self.path = experiment.path
        self.quantity = select_quantity(header.on, header.config, header.force_unit)
        self.results: dict[tuple[str, ...], PointResult] = {}
        self._columns = tuple(columns)
        measured = self.quantity.measured
        rows = experiment.read_rows((*columns, *measured, RECORDING_COLUMN))
        for row in rows:
            given = {name: row[name] for name in measured if row[name]}
            try:
                result = msgspec.convert(given, self.quantity.result, strict=False)
            except msgspec.ValidationError as error:
                raise ConfigError(f"{self.path / ROWS}: not a table of a sweep: {error}") from None
            self.results[tuple(row[name] for name in columns)] = result

    def key(self, point: Point) -> tuple[str, ...]:
        """Return the key of a point: the values of its columns as text."""
        values = point.columns()
        return tuple(str(values.get(name, "")) for name in self._columns)

    def add_result(self, point: Point, result: PointResult, recording: bytes | Path) -> None:
        """Write the recording and the result of a point; raises `FishdError` if that fails.

        recording: content of the recording, or a file whose path `recording_path` returned
        """
        if isinstance(recording, bytes):
            path = self.recording_path(point)
            self.experiment.write(f"{RECORDINGS_FOLDER}/{path.name}", recording)
            recording = path
        key = self.key(point)
        values = msgspec.structs.asdict(result)
        row = dict(zip(self._columns, key, strict=True)) | values
        self.experiment.add_row(row | {RECORDING_COLUMN: f"{RECORDINGS_FOLDER}/{recording.name}"})
        self.results[key] = result

    def recording_path(self, point: Point) -> Path:
        """Return an unused path for the recording of the next point."""
        folder = self.experiment.make_folder(RECORDINGS_FOLDER)
        number = len(self.results) + 1
        while any(folder.glob(f"{number:04d}-*")):
            number += 1
        return folder / f"{number:04d}-{point.controller}.mcap"

    def sort(self, points: Sequence[Point]) -> None:
        """Sort the rows in the order of these points; other rows stay at the end."""
        order = {self.key(point): index for index, point in enumerate(points)}
        rows = self.experiment.read_rows(
            (*self._columns, *self.quantity.measured, RECORDING_COLUMN)
        )
        rows.sort(key=lambda row: order.get(tuple(row[n] for n in self._columns), len(order)))
        self.experiment.write_rows(rows)
