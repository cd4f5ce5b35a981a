"""Curves of a sweep: one for each controller and setting, and the best point of each."""

import json
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from fishd.lab.sweep.folder import SweepFolder
from fishd.lab.sweep.grid import PARAMETER_PREFIX, Point, find_axis, is_number
from fishd.lab.sweep.peak import Peak, find_peak
from fishd.lab.sweep.results import PointResult, Quantity

_WHOLE_TICK_TOLERANCE = 5e-3
"""Half beats that differ by less than this from whole ticks count as whole ticks [ticks].

The reversals of a short swim then stay in the same ticks.
"""


class Curve(NamedTuple):
    """Thrust or speed as a function of one quantity; all other settings are equal."""

    label: str
    over: str
    """Name of the quantity, such as `frequency` or `plant.xi`; empty for a single point."""
    points: list[Point]
    x: list[float]
    results: list[PointResult]
    peak: Peak | None
    """Maximum of the curve; None without a quantity, or if no point has a value."""


class WholeTicks(Struct, frozen=True):
    """The best measured point among the frequencies whose half beats are whole ticks."""

    frequency: float
    """Tail beats per second [Hz]."""
    thrust: float
    """Measured thrust [N]."""
    error: float | None
    """Half-width of the 95 % confidence interval of `thrust` [N]."""
    nearer: float | None
    """Frequency of whole ticks nearest the maximum of the curve, if it was not measured [Hz]."""


class Best(Struct, frozen=True):
    """The best point of a curve, in the form of the JSON output."""

    controller: str
    parameters: dict[str, Any]
    """Parameters of the highest measured point."""
    keys: dict[str, Any]
    """Keys of the configuration that differ at that point, in dotted form."""
    over: str
    """Name of the quantity along the curve, such as `frequency`; empty for a single point."""
    x: float | None
    """Value of the quantity at the maximum; None if nothing was varied."""
    x_low: float | None
    """Lower end of the 95 % confidence interval of `x`; None if the points do not determine it."""
    x_high: float | None
    """Upper end of that interval."""
    value: float
    """Thrust [N] or speed [m/s] at the maximum."""
    error: float | None
    """Half-width of the 95 % confidence interval of `value`."""
    at_edge: bool
    """Whether the highest point is at the edge of the grid; the maximum may lie beyond it."""
    whole_ticks: WholeTicks | None = None
    """Best point of whole ticks; None for a curve that is not over frequencies of whole ticks."""


def make_curves(folder: SweepFolder, points: Sequence[Point]) -> list[Curve]:
    """Return the curves through the measured points.

    A curve is a function of the quantity with the most values among the points of its controller.
    A point whose value there is not a number, such as `auto`, becomes a curve of one point.
    """
    groups: dict[tuple[str, str], list[Point]] = {}
    axes = {
        name: find_axis([point for point in points if point.controller == name])
        for name in {point.controller for point in points}
    }
    for point in points:
        if folder.key(point) in folder.results:
            columns = point.columns()
            quantity = axes[point.controller]
            quantity = quantity if is_number(columns.get(quantity)) else ""
            settings = {name: value for name, value in columns.items() if name != quantity}
            groups.setdefault((quantity, json.dumps(settings)), []).append(point)
    return [_make_curve(folder, group, quantity, points) for (quantity, _), group in groups.items()]


def find_best(curve: Curve) -> Best | None:
    """Return the best point of a curve; None if no point has a value."""
    measured = [
        (result.value, index)
        for index, result in enumerate(curve.results)
        if result.value is not None
    ]
    if not measured:
        return None
    value, index = max(measured)
    point, maximum = curve.points[index], curve.peak
    return Best(
        controller=point.controller,
        parameters=point.parameters,
        keys=point.keys,
        over=curve.over,
        x=maximum.x if maximum else None,
        x_low=maximum.x_low if maximum else None,
        x_high=maximum.x_high if maximum else None,
        value=maximum.y if maximum else value,
        error=maximum.y_error if maximum else curve.results[index].error,
        at_edge=maximum.at_edge if maximum else False,
    )


def best_to_builtins(best: Best, quantity: Quantity) -> dict[str, Any]:
    """Return the best point as plain data, its value under the name of the quantity."""
    fields = msgspec.structs.asdict(best)
    return {quantity.name if name == "value" else name: value for name, value in fields.items()}


def find_best_of_whole_ticks(folder: SweepFolder, curve: Curve) -> WholeTicks | None:
    """Return the best measured point without dithered half beats; None if there is none."""
    if curve.over != "frequency" or curve.peak is None or folder.quantity.name != "thrust":
        return None
    tick = float(curve.points[0].keys.get("tick", folder.experiment.header.config["tick"]))
    by_ticks = {
        round(0.5 / x / tick): (thrust, x, result.error)
        for x, result in zip(curve.x, curve.results, strict=True)
        if (thrust := result.value) is not None and x > 0.0 and _is_whole(0.5 / x / tick)
    }
    if not by_ticks:
        return None
    thrust, frequency, error = max(by_ticks.values(), key=lambda row: row[0])
    top = curve.peak.x
    half = 0.5 / top / tick
    neighbours = [ticks for ticks in (math.floor(half), math.ceil(half)) if ticks > 0]
    nearest = min(neighbours, key=lambda ticks: abs(0.5 / (ticks * tick) - top))
    return WholeTicks(
        frequency, thrust, error, None if nearest in by_ticks else 0.5 / (nearest * tick)
    )


def _is_whole(ticks: float) -> bool:
    """Return whether a half beat [ticks] counts as whole ticks."""
    return round(ticks) > 0 and abs(ticks - round(ticks)) < _WHOLE_TICK_TOLERANCE


def _make_curve(
    folder: SweepFolder, group: list[Point], quantity: str, all_points: Sequence[Point]
) -> Curve:
    results = [folder.results[folder.key(point)] for point in group]
    x = [float(point.columns()[quantity]) for point in group] if quantity else []
    measured = [
        (position, result.value, result.error)
        for position, result in zip(x, results, strict=False)
        if result.value is not None
    ]
    maximum = find_peak(*map(list, zip(*measured, strict=True))) if measured else None
    label = group[0].label(without={*_find_constant_columns(all_points), quantity})
    return Curve(label, quantity.removeprefix(PARAMETER_PREFIX), group, x, results, maximum)


def _find_constant_columns(points: Sequence[Point]) -> set[str]:
    """Return the columns with the same value at all points; none for a single point."""
    columns = [point.columns() for point in points]
    if len(columns) < 2:
        return set()
    return {
        name
        for name in dict.fromkeys(name for row in columns for name in row)
        if len({str(row[name]) for row in columns if name in row}) == 1
    }
