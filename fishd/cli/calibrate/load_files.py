"""CSV files of loads for `fishctl calibrate force`: plans and measurements."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click

from fishd.core import files
from fishd.core.calibration import ForceSample

G0 = 9.80665
"""Standard gravity [m/s²]: the weight of a gram is G0 millinewtons."""
NEWTONS = {"N": 1.0, "g": G0 * 1e-3}
"""Size of each unit [N]."""


class Step(NamedTuple):
    """Line of a file: forces [N], and voltages [V] if they were measured."""

    fx: float
    fy: float
    volts: tuple[float, float] | None
    where: str
    """Name of the file and number of the line."""
    unit: str
    """Unit of the forces in the file."""


def explain_excess(fx: float, fy: float, limit: float) -> str | None:
    """Return why a load [N] is outside ±`limit` of the sensor; None if it is inside."""
    largest = max(fx, fy, key=abs)
    if abs(largest) <= limit:
        return None
    return f"{largest:.4g} N is beyond force_sensor.force_limit, {limit:g} N"


def check_limit(steps: Sequence[Step], limit: float) -> None:
    """Raise `click.ClickException` for the first load beyond the limit [N]."""
    for step in steps:
        if problem := explain_excess(step.fx, step.fy, limit):
            hint = "; are these grams? Then name the columns fx_g,fy_g" if step.unit == "N" else ""
            raise click.ClickException(f"{step.where}: {problem}{hint}")


def read(path: Path, unit: str) -> list[Step]:
    """Return the loads of a file with columns fx_N and fy_N, and vx_V, vy_V if measured.

    The suffix may be _g, too; columns without one are in `unit`. Raises `click.ClickException`
    with one line that names file and line.
    """
    try:
        text = files.read_text(path, files.MAX_TABLE_BYTES, "a table of loads", "utf-8-sig")
        reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
        names = [name.strip() for name in reader.fieldnames or []]
        reader.fieldnames = names
        columns = _find_columns(path, names, unit)
        steps = [_parse_step(f"{path}:{reader.line_num}", row, columns) for row in reader]
    except files.FileProblem as problem:
        raise click.ClickException(f"{path}: {problem}") from None
    except csv.Error as error:
        raise click.ClickException(f"{path}: not a CSV file: {error}") from None
    if not steps:
        raise click.ClickException(f"{path}: no loads below the header")
    return steps


def check_new(path: Path, *, replace: bool) -> None:
    """Raise `ClickException` if `write` would fail, or would replace a file without permission."""
    try:
        files.check_writable(path)
    except files.FileProblem as problem:
        raise click.ClickException(f"{path}: {problem}") from None
    if path.exists() and not replace:
        raise click.ClickException(f"{path}: is there already; --force replaces it")


def write(path: Path, measured: Sequence[tuple[tuple[float, float], ForceSample]]) -> None:
    """Write loads [N] and their samples [V] in the format of `read`; raises OSError."""
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(["fx_N", "fy_N", "vx_V", "vy_V", "vx_std_V", "vy_std_V", "pairs"])
    for (fx, fy), sample in measured:
        volts = (sample.vx, sample.vy, sample.vx_std, sample.vy_std)
        writer.writerow([*(f"{value:.9g}" for value in (fx, fy, *volts)), sample.pairs])
    files.write_atomically(path, table.getvalue())


def _find_columns(path: Path, names: list[str], unit: str) -> dict[str, tuple[str, float]]:
    """Return for each quantity its column, and the unit of that column in SI."""
    columns = {}
    for quantity in ("fx", "fy"):
        spellings = {f"{quantity}_{suffix}": factor for suffix, factor in NEWTONS.items()}
        spellings[quantity] = NEWTONS[unit]
        candidates = [(name, spellings[name]) for name in names if name in spellings]
        if len(candidates) != 1:
            raise click.ClickException(
                f"{path}:1: one column {quantity}_N or {quantity}_g is needed, such as in the "
                "header fx_N,fy_N,vx_V,vy_V"
            )
        columns[quantity] = candidates[0]
    measured = [name for name in ("vx_V", "vy_V") if name in names]
    if len(measured) == 1:
        raise click.ClickException(f"{path}:1: vx_V and vy_V are needed, or neither for a plan")
    columns.update({name[:2]: (name, 1.0) for name in measured})
    return columns


def _parse_step(where: str, row: dict[str, str], columns: dict[str, tuple[str, float]]) -> Step:
    values = {}
    unit = "N" if {columns["fx"][1], columns["fy"][1]} == {1.0} else "g"
    for quantity, (column, factor) in columns.items():
        text = row[column]
        try:
            values[quantity] = float(text) * factor
        except (TypeError, ValueError):
            values[quantity] = math.nan
        if not math.isfinite(values[quantity]):
            raise click.ClickException(f"{where}: {column}: '{text or ''}' is not a number")
    volts = (values["vx"], values["vy"]) if "vx" in values else None
    return Step(values["fx"], values["fy"], volts, where, unit)
