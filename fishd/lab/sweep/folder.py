"""The results of a sweep by their points, in the table of its experiment, with their recordings."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from fishd.core.errors import ConfigError
from fishd.lab.experiment import ROWS, Experiment
from fishd.lab.sweep.grid import Point
from fishd.lab.sweep.results import Found, quantity_of

RECORDINGS = "ticks"
RECORDING = "recording"
"""Name of the column with the recording of a point."""


class SweepFolder:
    """Points that are kept as they are measured; `results` has them by their key."""

    def __init__(self, experiment: Experiment, columns: Sequence[str]) -> None:
        """
        columns: names of what differs from point to point, as in `Point.columns`

        Raises `ConfigError` where the table is of another sweep.
        """
        header = experiment.header
        self.experiment = experiment
        self.path = experiment.path
        self.quantity = quantity_of(header.on, header.config, header.force_unit)
        self.results: dict[tuple[str, ...], Found] = {}
        self._columns = tuple(columns)
        measured = self.quantity.measured
        rows = experiment.read_rows((*columns, *measured, RECORDING))
        for row in rows:
            given = {name: row[name] for name in measured if row[name]}
            try:
                result = msgspec.convert(given, self.quantity.result, strict=False)
            except msgspec.ValidationError as error:
                raise ConfigError(f"{self.path / ROWS}: not a table of a sweep: {error}") from None
            self.results[tuple(row[name] for name in columns)] = result

    def key(self, point: Point) -> tuple[str, ...]:
        """Return what tells a point from the others: its columns as text."""
        values = point.columns()
        return tuple(str(values.get(name, "")) for name in self._columns)

    def keep(self, point: Point, result: Found, recording: bytes | Path) -> None:
        """Keep what was measured, its recording first; raises `FishdError` when it cannot be.

        recording: its content, or a file that `recording_of` has named
        """
        if isinstance(recording, bytes):
            path = self.recording_of(point)
            self.experiment.write(f"{RECORDINGS}/{path.name}", recording)
            recording = path
        key = self.key(point)
        values = msgspec.structs.asdict(result)
        row = dict(zip(self._columns, key, strict=True)) | values
        self.experiment.add_row(row | {RECORDING: f"{RECORDINGS}/{recording.name}"})
        self.results[key] = result

    def recording_of(self, point: Point) -> Path:
        """Return a free name for the recording of the next point."""
        folder = self.experiment.make_folder(RECORDINGS)
        number = len(self.results) + 1
        while any(folder.glob(f"{number:04d}-*")):
            number += 1
        return folder / f"{number:04d}-{point.controller}.mcap"

    def sort(self, points: Sequence[Point]) -> None:
        """Put the rows in the order of these points; others stay at the end."""
        order = {self.key(point): index for index, point in enumerate(points)}
        rows = self.experiment.read_rows((*self._columns, *self.quantity.measured, RECORDING))
        rows.sort(key=lambda row: order.get(tuple(row[n] for n in self._columns), len(order)))
        self.experiment.write_rows(rows)
