"""Recordings of other rigs: tables of forces and angles as ticks, as fishd would record them.

`read_table` reads a text file, `make_ticks` makes ticks of arrays, such as those of pandas, and
`RunWriter` records them.
"""

import codecs
import csv
import math
import re
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
from fishd.lab.limits import find_excess

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
MAX_PERIOD_S = 1.0
"""Longest time between most rows without a stated rate; a longer one is a mistake [s]."""
MAX_RATE_ERROR = 0.2
"""Largest relative difference between a stated rate and the times."""
_MAX_ROUNDING = 1.2
"""Largest range of the errors of even times, in units of the last digit: 1, and the fit's error."""
_BINARY = re.compile(rb"[\0-\x08\x0e-\x19\x7f]")
"""Bytes that no text has."""
_NUMBER = re.compile(r"\s*[-+]?[\d.,]*\d[\d.,]*(e[-+]?\d+)?\s*", re.IGNORECASE)
"""Number whose points and commas may be decimal or separate thousands."""
_GROUPED = re.compile(r"\s*[-+]?\d{1,3}([.,])\d{3}(\1\d{3})*([.,]\d*)?\s*")
"""Number with separators of thousands, which may have a decimal point or comma, too."""
MAX_GAP_PERIODS = 1e8
"""Longest time between two rows, in times between most [1]; a longer one is a mistake."""
MAX_QUANTITIES = 100
"""Largest number of columns that fishd does not know."""
REST_DELAY_S = 2.5
"""Time without a change of φ_c after which the fish is at rest, as for a live thrust [s]."""
_WAVE = (CONTROLLER, dict[str, float]())

Array = NDArray[np.float64]
Line = tuple[int, list[str]]
"""Number of a line of a file, and its cells."""


def read_table(path: Path, names: Sequence[str] | None = None) -> dict[str, Array]:
    """Return the columns of a text file in SI units, by their names without the unit.

    The columns are separated by semicolons, tabs, commas or spaces; numbers may have decimal
    commas, which then all have. Lines without a number are those of a header. A cell that is empty
    or `nan` is NaN.

    names: names of all columns in order, such as `fx_mN`, `-` to leave one out; by default those in
        the first line of the file. An unknown column keeps its name, and its unit
    Raises `RecordingError` with one line that names the file, and the line where one is wrong.
    """
    try:
        content = _decode(path, files.read(path, MAX_TABLE_BYTES, "a table"))
        lines = list(_split_lines(content))
    except files.FileProblem as problem:
        raise RecordingError(f"{path}: {problem}") from None
    except csv.Error as error:
        raise RecordingError(f"{path}: not a table: {error}") from None
    if not lines:
        raise RecordingError(f"{path}: it is empty: a table of numbers is needed")
    if names is None:
        _drop_empty_cells(lines[0][1], 1)
    named = list(names) if names is not None else lines[0][1]
    columns = [_parse_name(path, name.strip()) for name in named]
    kept = [index for index, (name, _) in enumerate(columns) if name != LEFT_OUT]
    _check_names(path, [columns[index][0] for index in kept], from_file=names is None)
    table_lines = _drop_header(lines, kept)
    for number, cells in table_lines:
        _drop_empty_cells(cells, len(columns))
        if len(cells) != len(columns):
            raise RecordingError(
                f"{path}: line {number} has {len(cells)} columns, not {len(columns)}: name each "
                f"with --columns, '{LEFT_OUT}' for one to leave out"
            )
    if doubt := _find_ambiguous_number(table_lines, kept):
        raise RecordingError(f"{path}: {doubt}")
    rows: list[list[float]] = []
    for number, cells in table_lines:
        values = [_parse_number(cells[index]) for index in kept]
        for index, value in zip(kept, values, strict=True):
            if value is None:
                raise RecordingError(
                    f"{path}: line {number}, {columns[index][0]}: '{text.quoted(cells[index])}' is "
                    "not a number such as 1000.5; leave the cell empty where one is missing"
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
        if problem := find_excess(name, table[name]):
            raise RecordingError(problem)
    intervals = np.diff(table["time"])
    if not np.all(intervals > 0.0):
        row = int(np.argmin(intervals > 0.0))
        raise RecordingError(
            f"the times do not increase: {table['time'][row]:.10g} s, then "
            f"{table['time'][row + 1]:.10g} s, in rows {rows[row] + 1} and {rows[row + 1] + 1} of "
            f"the numbers; sort the rows by time, or leave the times out ('{LEFT_OUT}') and state "
            "--rate HZ"
        )
    has_gaps = float(intervals.max()) > 1.5 * float(np.median(intervals))
    even = _find_even_times(table["time"]) if has_gaps else None
    if even is not None:
        table["time"], intervals = even, np.diff(even)
    usual = float(np.median(intervals))
    if rate is None and usual > MAX_PERIOD_S:
        raise RecordingError(
            f"most rows are {usual:.3g} s apart: is the time in milliseconds (time_ms)? If not, "
            f"state --rate {1.0 / usual:.3g}"
        )
    if rate is not None and abs(usual * rate - 1.0) > MAX_RATE_ERROR:
        raise RecordingError(
            f"most rows are {usual:.3g} s apart, not {1.0 / rate:.3g} s as --rate {rate:g} states: "
            f"leave that out, or the times ('{LEFT_OUT}')"
        )
    period = usual if even is not None or rate is None else 1.0 / rate
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
            readings={"power": float(table["power"][index])} if "power" in table else UNSET,
            suspect=f"the table has no {missing}" if missing else UNSET,
        )
        applied, before = angles[index], now


def _find_even_times(time: Array) -> Array | None:
    """Return even times that differ from the given ones by their rounding only; None without such.

    Rounded to 10 ms, the rows of 96 Hz are 10 or 20 ms apart, and none is missing.
    """
    since, rows = time - time[0], np.arange(len(time))
    precision = 1e-7 + 2.0 * float(np.spacing(np.abs(time).max()))
    for decimals in range(7):
        if np.allclose(np.round(since, decimals), since, rtol=0.0, atol=precision):
            even = np.polyval(np.polyfit(rows, since, 1), rows)
            is_rounding = np.ptp(even - since) <= _MAX_ROUNDING * 10.0**-decimals
            return time[0] + even if is_rounding else None
    return None


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


def _decode(path: Path, raw: bytes) -> str:
    """Return the text of a table; raise `RecordingError` for a file of another format."""
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return raw.decode("utf-16", "replace")
    if _BINARY.search(raw[:4096]):
        raise RecordingError(f"{path}: it is not a text: save the table as CSV (UTF-8)")
    return raw.decode("utf-8-sig", "replace")


def _split_lines(content: str) -> Iterator[Line]:
    """Yield the number and the cells of each line that is not empty; raise `csv.Error`."""
    lines = content.splitlines()
    sample = [line for line in lines[:50] if line.strip()]
    delimiter = _find_delimiter(sample[-1]) if sample else None
    rows: Iterator[list[str]] = (line.split() for line in lines)
    if delimiter:
        rows = csv.reader(lines, delimiter=delimiter)
    for number, cells in enumerate(rows, start=1):
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


def _drop_empty_cells(cells: list[str], count: int) -> None:
    """Remove empty cells at the end, such as after a last separator, beyond this count of cells."""
    while len(cells) > count and not cells[-1].strip():
        cells.pop()


def _drop_header(lines: Sequence[Line], kept: Sequence[int]) -> Sequence[Line]:
    """Return the lines from the first one with a number in a column that is kept."""
    for begin, (_, cells) in enumerate(lines):
        for cell in (cells[index] for index in kept if index < len(cells)):
            value = _parse_number(cell)
            if _GROUPED.fullmatch(cell) or (value is not None and not math.isnan(value)):
                return lines[begin:]
    return []


def _find_ambiguous_number(lines: Sequence[Line], kept: Sequence[int]) -> str:
    """Return in words which point or comma may separate thousands; empty if none may."""
    marked: dict[str, str] = {}
    for number, cells in lines:
        for cell in (cells[index] for index in kept):
            for mark in ".,":
                if mark in cell and mark not in marked and _NUMBER.fullmatch(cell):
                    marked[mark] = f"{text.quoted(cell)} in line {number}"
    if len(marked) > 1:
        return (
            f"its numbers have both '.' and ',': {' and '.join(marked.values())}; save it without "
            "separators of thousands"
        )
    for mark in marked:
        grouped = re.compile(rf"[-+]?[1-9]\d{{0,2}}({re.escape(mark)}\d{{3}})+")
        columns = [[cells[index].strip() for _, cells in lines] for index in kept]
        large = [[cell for cell in column if mark in cell] for column in columns]
        if not all(grouped.fullmatch(cell) for column in large for cell in column):
            continue
        for column, cells in zip(columns, large, strict=True):
            whole = [cell for cell in column if cell.lstrip("+-").isdecimal()]
            small = [cell for cell in whole if 0.0 < abs(float(cell)) < 1000.0]
            if cells and small:
                return (
                    f"{text.quoted(cells[0])} beside {text.quoted(small[0])}: it is unclear "
                    f"whether '{mark}' separates thousands or decimals; save it without "
                    "separators of thousands, or with as many decimals in each number"
                )
    return ""


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
    if len(names) - len(known) > MAX_QUANTITIES:
        raise RecordingError(f"{path}: more than {MAX_QUANTITIES} columns that fishd does not know")
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(f"{path}: two columns are named '{text.quoted(name)}'")


def _parse_number(cell: str) -> float | None:
    """Return the number in a cell, NaN for an empty one; None for a text."""
    word = cell.strip().replace(",", ".")
    try:
        return None if "_" in word else float(word) if word else math.nan
    except ValueError:
        return None
