"""Results of runs with their intervals, in one form for recordings and all kinds of experiments."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.controllers import registry
from fishd.core import text
from fishd.core.errors import ConfigError, UnknownController
from fishd.core.files import FileProblem
from fishd.lab.experiment import find_answer, read_header, read_number, read_result, read_rows
from fishd.lab.statistics import mean_ci95, per_watt
from fishd.recording import Run, open_run

MEANS = 10
"""Number of parts of a swim whose means give the interval of its mean."""
MAX_ROWS = 5000
"""Largest number of rows of a table that are returned."""


class Quantity(NamedTuple):
    """Quantity of a result."""

    unit: str
    factor: float
    """Number by which a value in SI units is multiplied for display."""

    def format(self, value: tuple[float, float | None] | None, force_unit: str = "N") -> str:
        """Return value and half-width as text, with the unit of a force that is not in newtons."""
        if value is None:
            return "–"
        mean, ci95 = value[0] * self.factor, value[1]
        own = self.unit.replace("N", text.quoted(force_unit)) if "N" in self.unit else self.unit
        unit = "" if own == self.unit else f" {own}"
        if ci95 is None:
            return f"{mean:.4g}{unit}" if self.unit == "%" else f"{mean:.4g} ± ?{unit}"
        return f"{text.format_measured(mean / 1e3, ci95 * self.factor / 1e3)}{unit}"


QUANTITIES = {
    "thrust": Quantity("mN", 1e3),
    "speed": Quantity("mm/s", 1e3),
    "frequency": Quantity("Hz", 1.0),
    "power": Quantity("mW", 1e3),
    "thrust_per_watt": Quantity("mN/W", 1e3),
    "relative_thrust": Quantity("%", 1e2),
    "fin_angle_max": Quantity("mrad", 1e3),
}


class Row(Struct):
    """One result of a run."""

    label: str
    """Controller with its parameters, or the name of a contestant."""
    values: dict[str, tuple[float, float | None]]
    """Value and half-width of its 95 % interval by name of the quantity, in SI units."""


class Estimate(NamedTuple):
    """Parameter in the result of an experiment."""

    name: str
    value: float
    low: float | None
    high: float | None
    unit: str


class Results(Struct):
    """Results of a run."""

    name: str
    kind: str
    rows: list[Row] = []
    estimates: list[Estimate] = []
    force_unit: str = "N"
    """Unit of forces: `N`, or that of a sensor that is not calibrated."""
    summary: str = ""
    """Result other than a number, in words."""
    columns: dict[str, list[float | None]] = {}
    """Numeric columns of the table of an experiment."""
    labels: list[str] = []
    """Controller in each row of that table."""


def read_results(path: Path) -> Results:
    """Return the results of a recording, or of the experiment in a folder; raise `FishdError`."""
    if not path.is_dir():
        run = open_run(path)
        return Results(run.name, "recording", [_measure(run)], [], run.summary.force_unit)
    header = read_header(path)
    try:
        results = read_result(path)
    except FileProblem as problem:
        raise ConfigError(str(problem)) from None
    table = read_rows(path)[:MAX_ROWS]
    names = dict.fromkeys(name for row in table for name in row)
    columns = {name: [read_number(row.get(name)) for row in table] for name in names}
    gaits = [gait for result in results for gait in result.get("gaits", [result])]
    rows = [Row(_find_label(gait), _find_values(gait)) for gait in gaits]
    estimates = [estimate for result in results for estimate in _list_estimates(result)]
    summary = "" if estimates else find_answer(path, header.kind).summary
    said = [str(r.get("verdict") or r.get("headline") or "") for r in results[:1]]
    return Results(
        path.name,
        header.kind,
        [row for row in rows if row.values],
        estimates,
        header.force_unit,
        text.line(said[0]) if len(results) == 1 and said[0] else summary,
        {name: values for name, values in columns.items() if any(v is not None for v in values)},
        [row.get("controller", "") for row in table],
    )


def _find_label(result: Mapping[str, Any]) -> str:
    parameters = result.get("parameters") or {}
    listed = ",".join(
        f"{name}={value:.4g}" if isinstance(value, float) else f"{name}={value}"
        for name, value in parameters.items()
        if value is not None
    )
    label = result.get("contestant") or ":".join(filter(None, (result.get("controller"), listed)))
    return text.line(str(label))


def _find_values(result: Mapping[str, Any]) -> dict[str, tuple[float, float | None]]:
    """Return the known quantities of a result with their half-widths."""
    values = {}
    for name in QUANTITIES:
        value = read_number(result.get(name, result.get(f"beat_{name}")))
        if value is not None:
            total = read_number(result.get(f"{name}_total_ci95"))
            if name == "thrust":
                total = read_number(result.get("total_ci95"))
            ci95 = read_number(result.get(f"{name}_ci95"))
            values[name] = value, ci95 if total is None else total
    return values


def _list_estimates(result: Mapping[str, Any]) -> Iterator[Estimate]:
    """Yield the parameters that a result states with intervals."""
    controller, parameters = str(result.get("controller", "")), result.get("parameters") or {}
    units: dict[str, str] = {}
    with suppress(UnknownController):
        units = registry.units(controller) if controller else {}
    lows, highs = (result.get(f"parameters_ci95_{end}") or {} for end in ("low", "high"))
    values = [
        (name, parameters.get(name), low, highs.get(name), units.get(name, ""))
        for name, low in lows.items()
    ]
    if name := result.get("x_name"):  # the best point of a curve
        ends = (result.get("x_ci95_low"), result.get("x_ci95_high"))
        values.append((name, result.get("x"), *ends, units.get(name, "")))
    fitted = result.get("fitted") or {}
    identified = fitted.get("identification", result) if isinstance(fitted, dict) else result
    for name, estimate in (identified.get("estimates") or {}).items():
        if estimate.get("fitted", True):
            ends = (estimate.get("ci95_low"), estimate.get("ci95_high"))
            values.append((name, estimate["value"], *ends, estimate.get("unit", "")))
    for name, value, low, high, unit in values:
        if (number := read_number(value)) is not None:
            yield Estimate(str(name), number, read_number(low), read_number(high), str(unit))


def _measure(run: Run) -> Row:
    """Return the means of a recording while a controller swam."""
    summary = run.summary
    swum = [tick for tick in run.ticks if tick.mode == "running"]
    values: dict[str, tuple[float, float | None]] = {}
    if summary.thrust is not None:
        values["thrust"] = summary.thrust, summary.thrust_ci95
    if frequencies := [tick.frequency for tick in swum if tick.frequency]:
        values["frequency"] = _find_mean(frequencies)
    powers = [tick.readings["power"] for tick in swum if tick.readings and "power" in tick.readings]
    if powers:
        values["power"] = _find_mean(powers)
        ratio = per_watt(summary.thrust or 0.0, summary.thrust_ci95, *values["power"])
        if ratio[0] is not None:
            values["thrust_per_watt"] = ratio
    return Row(text.line(", ".join(summary.swim_ticks) or "at rest"), values)


def _find_mean(values: Sequence[float]) -> tuple[float, float | None]:
    """Return the mean of ticks, and its half-width from the means of equal parts."""
    size = max(1, len(values) // MEANS)
    parts = [values[start : start + size] for start in range(0, size * (len(values) // size), size)]
    return fmean(values), mean_ci95([fmean(part) for part in parts])
