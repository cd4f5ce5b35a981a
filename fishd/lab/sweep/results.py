"""Result at each point of a sweep, a thrust or the speed of a free fish, and their folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct
from msgspec.structs import fields

from fishd.core.errors import ConfigError
from fishd.core.robots import find_kind
from fishd.lab.experiment import ROWS, Experiment
from fishd.lab.sweep.grid import Point

RECORDINGS_FOLDER = "ticks"
RECORDING_COLUMN = "recording"
"""Name of the column with the path of a point's recording."""


class Result(Struct, frozen=True):
    """Thrust at a point; the fields are the measured columns of a sweep's table."""

    thrust: float | None = None
    """Mean thrust over whole tail beats [N]; None if there is `failure`."""
    thrust_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust` [N]; None if unknown."""
    beat_frequency: float = 0.0
    """Tail beats per second; 0 if the tail does not beat [Hz]."""
    relative_thrust: float | None = None
    """Thrust divided by the thrust of the best square wave; of a simulated fish."""
    fin_amplitude: float | None = None
    """Mean over half beats of the largest fin angle [rad]; of a simulated fish."""
    fin_angle_max: float | None = None
    """Mean over beats of the largest fin angle that a camera measured [rad]; None without one."""
    fin_angle_max_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `fin_angle_max` [rad]."""
    power: float | None = None
    """Electrical power of the servo [W]; None if unknown."""
    thrust_per_watt: float | None = None
    """Thrust divided by `power` [N/W]."""
    thrust_per_watt_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust_per_watt` [N/W]; simulated power counts
    as exact."""
    seconds: float = 0.0
    """Duration of swimming and resting [s]."""
    failure: str = ""
    """Reason for a missing thrust; empty if there is a thrust."""

    @property
    def value(self) -> float | None:
        """Quantity that curves show."""
        return self.thrust

    @property
    def value_ci95(self) -> float | None:
        """Half-width of the 95 % confidence interval of `value`; None if unknown."""
        return self.thrust_ci95


class SpeedResult(Struct, frozen=True):
    """Speed at a point of a freely swimming fish; powers are those of a fish one metre deep."""

    speed: float | None = None
    """Mean forward speed over whole tail beats [m/s]; None if there is `failure`."""
    speed_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `speed` [m/s]; None if unknown."""
    grid_error: float | None = None
    """Half-width of the error of `speed` by the grid [m/s]; None if it is not known."""
    beat_frequency: float = 0.0
    """Tail beats per second; 0 if the tail does not beat [Hz]."""
    beats: int = 0
    """Number of measured beats."""
    settled_time: float | None = None
    """Time at which the measured beats begin [s]; None if the speed still changed at the end."""
    tail_width: float | None = None
    """Distance of the tail tip from side to side, in body lengths."""
    muscle_power: float | None = None
    """Power of the muscles [W/m]."""
    cost_of_transport: float | None = None
    """Energy per mass and distance [J/(kg m)]."""
    strouhal: float | None = None
    froude_efficiency: float | None = None
    seconds: float = 0.0
    """Duration of the swim [s]."""
    failure: str = ""
    """Reason for a missing speed; empty if there is a speed."""

    @property
    def value(self) -> float | None:
        """Quantity that curves show."""
        return self.speed

    @property
    def value_ci95(self) -> float | None:
        """Half-width of the 95 % confidence interval of `value`; None if unknown."""
        return self.speed_ci95


PointResult = Result | SpeedResult


class Quantity(NamedTuple):
    """Quantity that a sweep measures."""

    name: str
    unit: str
    result: type[Result] | type[SpeedResult]

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured columns of the table."""
        return tuple(field.name for field in fields(self.result))


def select_quantity(on: str, config: Mapping[str, Any], force_unit: str) -> Quantity:
    """Return the quantity that a sweep of this fish measures; config: as plain data."""
    if on == "simulation" and not find_kind(config["robot"]).is_tethered:
        return Quantity("speed", "m/s", SpeedResult)
    return Quantity("thrust", force_unit, Result)


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
        self._table = experiment.open_table((*columns, *measured, RECORDING_COLUMN))
        for row in self._table.rows:
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
        self._table.add(row | {RECORDING_COLUMN: f"{RECORDINGS_FOLDER}/{recording.name}"})
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
        names = (*self._columns, *self.quantity.measured, RECORDING_COLUMN)
        rows = self.experiment.open_table(names).rows
        rows.sort(key=lambda row: order.get(tuple(row[n] for n in self._columns), len(order)))
        self._table.replace(rows)
