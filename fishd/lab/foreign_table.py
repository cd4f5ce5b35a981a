"""Recordings of other rigs: tables of forces and angles as ticks, as fishd would record them.

`read_table` reads a text file, `make_ticks` makes ticks of arrays, such as those of pandas, and
`RunWriter` records them.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from fishd.assembly import build_estimator, build_live_thrust
from fishd.config import Config
from fishd.core import files, text
from fishd.core.errors import RecordingError
from fishd.core.signals import Measurement, Tick

_FORCES = {"N": 1.0, "mN": 1e-3, "g": 9.80665e-3}
_ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
UNITS = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "fx": _FORCES,
    "fy": _FORCES,
    "phi_c": _ANGLES,
    "alpha": _ANGLES,
    "power": {"W": 1.0, "mW": 1e-3},
}
"""Known columns with their units, the SI unit first, which also is that of a name without one."""
LEFT_OUT = "-"
"""Name of a column that is left out."""
CONTROLLER = "imported"
"""Name of the controller in ticks of another rig."""
MAX_TABLE_BYTES = 256 * 2**20
"""Largest size of a file [bytes]: 100 columns of an hour at 50 Hz."""
MAX_VALUE = 1e10
"""Largest value of a known column [s, N, rad, W]; a larger one is a mistake."""
MAX_GAP_PERIODS = 1e8
"""Longest time between two rows, in times between most [1]; a longer one is a mistake."""
MAX_QUANTITIES = 100
"""Largest number of columns that fishd does not know."""
REST_DELAY_S = 2.5
"""Time without a change of φ_c after which the fish is at rest, as for a live thrust [s]."""
_WAVE = (CONTROLLER, dict[str, float]())

Array = NDArray[np.float64]


def read_table(path: Path, names: Sequence[str] | None = None) -> dict[str, Array]:
    """Return the columns of a text file in SI units, by their names without the unit.

    The columns are separated by semicolons, tabs, commas or spaces; a number may have a decimal
    comma. Lines without a number are those of a header. A cell that is empty or `nan` is NaN.

    names: names of all columns in order, such as `fx_mN`, `-` to leave one out; by default those in
        the first line of the file. An unknown column keeps its name, and its unit
    Raises `RecordingError` with one line that names the file, and the line where one is wrong.
    """
    try:
        raw = files.read(path, MAX_TABLE_BYTES, "a table").decode("utf-8-sig", "replace")
        lines = list(_split_lines(raw))
    except files.FileProblem as problem:
        raise RecordingError(f"{path}: {problem}") from None
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table: {error}") from None
    if not lines:
        raise RecordingError(f"{path}: it is empty: a table of numbers is needed")
    named = list(names) if names is not None else lines[0][1]
    columns = [_parse_name(path, name.strip()) for name in named]
    kept = [index for index, (name, _) in enumerate(columns) if name != LEFT_OUT]
    _check_names(path, [columns[index][0] for index in kept], from_file=names is None)
    rows: list[list[float]] = []
    for number, cells in lines:
        values = [_parse_number(cells[index]) if index < len(cells) else None for index in kept]
        if not rows and all(value is None or math.isnan(value) for value in values):
            continue  # of the header
        if len(cells) != len(columns):
            raise RecordingError(
                f"{path}: line {number} has {len(cells)} columns, not {len(columns)}: name each "
                f"with --columns, '{LEFT_OUT}' for one to leave out"
            )
        for index, value in zip(kept, values, strict=True):
            if value is None:
                raise RecordingError(
                    f"{path}: line {number}, {columns[index][0]}: '{text.quoted(cells[index])}' is "
                    "not a number"
                )
        rows.append([value for value in values if value is not None])
    if not rows:
        raise RecordingError(f"{path}: no line of numbers in the columns that are named")
    table = np.array(rows).T
    return {
        columns[index][0]: columns[index][1] * column
        for index, column in zip(kept, table, strict=True)
    }


def make_ticks(
    columns: Mapping[str, Array], rate: float | None = None, samples: int = 1
) -> list[Tick]:
    """Return the ticks of a table, with thrust and tail beat as fishd estimates them.

    Rows in which a column has no number are left out, so that they are a gap. Without `fx` or `fy`,
    the forces count as suspect. Where φ_c rests, the fish is idle; without `phi_c` it swims all the
    time if there is a force.

    columns: arrays of shape (rows,) in SI units, by the names of `UNITS`; others are quantities
    rate: rows per second [Hz]; by default that of most times in `time`
    samples: number of samples since the row before whose mean each force is, for `identify`
    Raises `RecordingError`, whose message does not name the table.
    """
    table = {name: np.asarray(column, float) for name, column in columns.items()}
    length = len(next(iter(table.values()), ()))
    if any(column.shape != (length,) for column in table.values()):
        raise RecordingError("the columns have different lengths")
    if "time" not in table:
        if rate is None:
            raise RecordingError("without a column 'time', the rate is needed: --rate HZ")
        table["time"] = np.arange(length) / rate
    rows = np.flatnonzero(np.all([np.isfinite(column) for column in table.values()], axis=0))
    table = {name: column[rows] for name, column in table.items()}
    if len(rows) < 2:
        raise RecordingError("two rows of numbers or more are needed")
    for name in UNITS.keys() & table.keys():
        if (largest := np.abs(table[name]).max()) > MAX_VALUE:
            raise RecordingError(f"{name} is {largest:.3g} {next(iter(UNITS[name]))} somewhere")
    intervals = np.diff(table["time"])
    if not np.all(intervals > 0.0):
        row = int(np.argmin(intervals > 0.0))
        raise RecordingError(
            f"the times do not increase: {table['time'][row]:.10g} s, then "
            f"{table['time'][row + 1]:.10g} s, in rows {rows[row] + 1} and {rows[row + 1] + 1} of "
            "the numbers"
        )
    period = 1.0 / rate if rate is not None else float(np.median(intervals))
    if (longest := float(intervals.max())) > MAX_GAP_PERIODS * period:
        raise RecordingError(
            f"two rows are {longest:.3g} s apart, most are {period:.3g} s: is the unit of time "
            "right?"
        )
    steps = np.maximum(1, np.round(intervals / period)).astype(int)
    numbers = np.concatenate(([1], 1 + np.cumsum(steps)))
    return list(_estimate(table, numbers, period, samples))


def _estimate(
    table: Mapping[str, Array], numbers: NDArray[np.int_], period: float, samples: int
) -> Iterator[Tick]:
    """Yield the ticks; numbers: number of each, period: time between two without a gap [s]."""
    time, swims = table["time"], _find_swims(table)
    zeros = np.zeros(len(time))
    fx, fy, angles = (table.get(name, zeros).tolist() for name in ("fx", "fy", "phi_c"))
    others = {name: table[name].tolist() for name in table if name not in UNITS}
    missing = " and ".join(name for name in ("fx", "fy") if name not in table)
    settings = Config()
    estimator, live = build_estimator(settings), build_live_thrust(settings)
    leak, applied, before = estimator.found_leak, angles[0], float(time[0]) - period
    for index, now in enumerate(time.tolist()):
        measurement = Measurement(now, fx[index], fy[index], samples)
        if index and swims[index - 1] and not swims[index]:
            estimator.rest()
        seen = estimator.update(measurement, applied, now, now - before, live.factor)
        if estimator.found_leak != leak:
            leak = estimator.found_leak
            live.forget_factor()
        live.update(seen, bool(swims[index]), _WAVE)
        is_known = live.thrust is not None and not missing
        yield Tick(
            t=now,
            seq=int(numbers[index]),
            mode="running" if swims[index] else "idle",
            controller=CONTROLLER if swims[index] else "hold",
            fx=fx[index],
            fy=fy[index],
            fy_rate=seen.fy_rate,
            fin_velocity=seen.fin_velocity,
            phi_c=angles[index],
            servo_on=True,
            thrust=live.thrust if is_known and live.thrust is not None else seen.thrust,
            thrust_ci95=live.ci95 if is_known else UNSET,
            frequency=seen.frequency,
            samples=samples,
            sample_age_ms=0.0,
            lateness_us=0.0,
            busy_time_us=0.0,
            missed_slots=0,
            alpha=float(table["alpha"][index]) if "alpha" in table else UNSET,
            quantities={name: column[index] for name, column in others.items()} or UNSET,
            time=now,
            power=float(table["power"][index]) if "power" in table else UNSET,
            suspect=f"the table has no {missing}" if missing else UNSET,
        )
        applied, before = angles[index], now


def _find_swims(table: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return in which rows the fish swims: between two changes of φ_c that are close in time."""
    time = table["time"]
    if "phi_c" not in table:
        return np.full(len(time), "fx" in table)
    changes = 1 + np.flatnonzero(np.diff(table["phi_c"]))
    swims = np.zeros(len(time), bool)
    for first, last in pairwise(changes):
        if time[last] - time[first] < REST_DELAY_S:
            swims[first : last + 1] = True
    return swims


def _split_lines(content: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of each line that is not empty; raise `csv.Error`."""
    lines = content.splitlines()
    sample = [line for line in lines[:50] if line.strip()]
    delimiter = _find_delimiter(sample[-1]) if sample else None
    rows: Iterator[list[str]] = (line.split() for line in lines)
    if delimiter:
        rows = csv.reader(lines, delimiter=delimiter)
    for number, cells in enumerate(rows, start=1):
        while len(cells) > 1 and not cells[-1].strip():  # a separator at the end of the line
            cells.pop()
        if any(cell.strip() for cell in cells):
            yield number, cells


def _find_delimiter(line: str) -> str | None:
    """Return what separates the columns in a line of numbers; None for spaces.

    A comma may be a decimal comma: the separator that leaves most numbers whole is right.
    """

    def count(delimiter: str | None) -> tuple[float, int]:
        cells = line.split(delimiter)
        numbers = [cell for cell in cells if _is_number(cell.strip())]
        return len(numbers) / len(cells), len(cells)

    return max((";", "\t", ",", None), key=count)


def _is_number(word: str) -> bool:
    return word.strip(",") == word and _parse_number(word) is not None


def _parse_name(path: Path, name: str) -> tuple[str, float]:
    """Return the name of a column without its unit, and the size of its unit."""
    known, _, unit = name.rpartition("_") if name.lower() not in UNITS else (name, "", "")
    units = UNITS.get(known.lower())
    if units is None:
        for other in UNITS:
            if name.lower().startswith(f"{other}_"):
                raise RecordingError(f"{path}: column '{text.quoted(name)}': {_list_units(other)}")
        return name, 1.0
    if unit and unit not in units:
        raise RecordingError(f"{path}: column '{text.quoted(name)}': {_list_units(known.lower())}")
    return known.lower(), units[unit] if unit else 1.0


def _list_units(name: str) -> str:
    return f"its unit must be one of {', '.join(f'{name}_{unit}' for unit in UNITS[name])}"


def _check_names(path: Path, names: Sequence[str], *, from_file: bool) -> None:
    known = [name for name in names if name in UNITS]
    if not known or known == ["time"]:
        where = "its first line names" if from_file else "--columns names"
        raise RecordingError(
            f"{path}: {where} neither force nor angle; name the columns in order, such as "
            "--columns time_s,fx_mN,fy_mN,phi_c_deg"
        )
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(f"{path}: two columns are named '{text.quoted(name)}'")
    if len(names) - len(known) > MAX_QUANTITIES:
        raise RecordingError(f"{path}: more than {MAX_QUANTITIES} columns that fishd does not know")


def _parse_number(cell: str) -> float | None:
    """Return the number in a cell, NaN for an empty one; None for a text."""
    word = cell.strip().replace(",", ".")
    try:
        return float(word) if word else math.nan
    except ValueError:
        return None
