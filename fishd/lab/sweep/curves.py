"""Curves of a sweep: one for each controller and setting, and the best point of each."""

import json
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

from fishd.lab.statistics import Z95, student95
from fishd.lab.sweep.grid import PARAMETER_PREFIX, Point, find_axis, is_number
from fishd.lab.sweep.results import PointResult, Quantity, SweepFolder

_WHOLE_TICK_TOLERANCE = 5e-3
"""Half beats that differ by less than this from whole ticks count as whole ticks [ticks].

The reversals of a short swim then stay in the same ticks.
"""
UPPER_FRACTION = 0.85
"""Fraction of the highest value above which neighbouring points belong to the parabola."""
MIN_POINTS = 5
"""Smallest number of points of the parabola."""


class Peak(NamedTuple):
    """Maximum of a curve y(x), in the units of x and y."""

    x: float
    """Position of the maximum."""
    x_ci95_low: float | None
    """Lower end of the 95 % confidence interval of `x`; None if the points do not determine it."""
    x_ci95_high: float | None
    """Upper end of that interval."""
    y: float
    """Value at the maximum."""
    y_ci95: float | None
    """Half-width of the 95 % confidence interval of `y`."""
    at_edge: bool
    """Whether the highest value is the first or the last, so that the maximum may lie beyond."""
    coefficients: tuple[float, float, float] | None
    """Coefficients a, b, c of the parabola a·(x − x₀)² + b·(x − x₀) + c; None if there is none."""
    centre: float
    """x₀ of the parabola."""
    span: tuple[float, float]
    """Range of x to which the parabola was fitted."""


class Curve(NamedTuple):
    """Thrust or speed as a function of one quantity; all other settings are equal."""

    label: str
    x_name: str
    """Name of the quantity, such as `frequency` or `plant.xi`; empty for a single point."""
    points: list[Point]
    x: list[float]
    results: list[PointResult]
    peak: Peak | None
    """Maximum of the curve; None without a quantity, or if no point has a value."""
    is_complete: bool
    """Whether all points of the grid are measured."""


class WholeTicks(Struct, frozen=True):
    """The best measured point among the frequencies whose half beats are whole ticks."""

    frequency: float
    """Tail beats per second [Hz]."""
    thrust: float
    """Measured thrust [N]."""
    thrust_ci95: float | None
    """Half-width of the 95 % confidence interval of `thrust` [N]."""
    nearest_frequency: float | None
    """Frequency of whole ticks nearest the maximum of the curve, if it was not measured [Hz]."""


class HighestPoint(Struct, frozen=True):
    """The highest measured point of a curve."""

    x: float | None
    """Value of the quantity along the curve; None if nothing was varied."""
    value: float
    """Measured thrust [N] or speed [m/s]."""
    value_ci95: float | None
    """Half-width of the 95 % confidence interval of `value`."""


class Best(Struct, frozen=True):
    """The best point of a curve, in the form of the JSON output.

    It is the maximum of the parabola, or the highest measured point of a curve without one.
    """

    controller: str
    parameters: dict[str, Any]
    """Parameters at the maximum."""
    keys: dict[str, Any]
    """Keys of the configuration that differ there, in dotted form."""
    x_name: str
    """Name of the quantity along the curve, such as `frequency`; empty for a single point."""
    x: float | None
    """Value of the quantity at the maximum; None if nothing was varied."""
    x_ci95_low: float | None
    """Lower end of the 95 % confidence interval of `x`; None if the points do not determine it."""
    x_ci95_high: float | None
    """Upper end of that interval."""
    value: float
    """Thrust [N] or speed [m/s] at the maximum."""
    value_ci95: float | None
    """Half-width of the 95 % confidence interval of `value`."""
    at_edge: bool
    """Whether the highest point is at the edge of the grid; the maximum may lie beyond it."""
    measured: HighestPoint
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
        columns = point.columns()
        quantity = axes[point.controller]
        quantity = quantity if is_number(columns.get(quantity)) else ""
        settings = {name: value for name, value in columns.items() if name != quantity}
        groups.setdefault((quantity, json.dumps(settings)), []).append(point)
    return [
        _make_curve(folder, group, quantity, points)
        for (quantity, _), group in groups.items()
        if any(folder.key(point) in folder.results for point in group)
    ]


def find_best(curve: Curve) -> Best | None:
    """Return the best point of a curve; None if it is not complete, or no point has a value."""
    measured = [
        (result.value, index)
        for index, result in enumerate(curve.results)
        if result.value is not None
    ]
    if not (measured and curve.is_complete):
        return None
    value, index = max(measured)
    point, maximum = curve.points[index], curve.peak
    error = curve.results[index].value_ci95
    parameters, keys = dict(point.parameters), dict(point.keys)
    if maximum:
        varied = parameters if curve.x_name in parameters else keys
        varied[curve.x_name] = maximum.x
    return Best(
        controller=point.controller,
        parameters=parameters,
        keys=keys,
        x_name=curve.x_name,
        x=maximum.x if maximum else None,
        x_ci95_low=maximum.x_ci95_low if maximum else None,
        x_ci95_high=maximum.x_ci95_high if maximum else None,
        value=maximum.y if maximum else value,
        value_ci95=maximum.y_ci95 if maximum else error,
        at_edge=maximum.at_edge if maximum else False,
        measured=HighestPoint(curve.x[index] if maximum else None, value, error),
    )


def best_to_builtins(best: Best, quantity: Quantity) -> dict[str, Any]:
    """Return the best point as plain data, its value under the name of the quantity."""
    names = {"value": quantity.name, "value_ci95": f"{quantity.name}_ci95"}

    def rename(values: dict[str, Any]) -> dict[str, Any]:
        return {names.get(name, name): value for name, value in values.items()}

    measured = rename(msgspec.structs.asdict(best.measured))
    return rename(msgspec.structs.asdict(best)) | {"measured": measured}


def find_best_of_whole_ticks(folder: SweepFolder, curve: Curve) -> WholeTicks | None:
    """Return the best measured point without dithered half beats; None if there is none."""
    if curve.x_name != "frequency" or curve.peak is None or folder.quantity.name != "thrust":
        return None
    tick = float(curve.points[0].keys.get("tick", folder.experiment.header.config["tick"]))
    by_ticks = {
        round(0.5 / x / tick): (thrust, x, result.value_ci95)
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
    is_known = nearest in by_ticks or curve.peak.x_ci95_low is None
    return WholeTicks(frequency, thrust, error, None if is_known else 0.5 / (nearest * tick))


def _is_whole(ticks: float) -> bool:
    """Return whether a half beat [ticks] counts as whole ticks."""
    return round(ticks) > 0 and abs(ticks - round(ticks)) < _WHOLE_TICK_TOLERANCE


def _make_curve(
    folder: SweepFolder, group: list[Point], quantity: str, all_points: Sequence[Point]
) -> Curve:
    total = len(group)
    group = [point for point in group if folder.key(point) in folder.results]
    is_complete = len(group) == total
    results = [folder.results[folder.key(point)] for point in group]
    x = [float(point.columns()[quantity]) for point in group] if quantity else []
    measured = [
        (position, result.value, result.value_ci95)
        for position, result in zip(x, results, strict=False)
        if result.value is not None
    ]
    maximum = find_peak(*map(list, zip(*measured, strict=True))) if measured else None
    if maximum and not is_complete:
        maximum = maximum._replace(coefficients=None)
    label = group[0].label(without={*_find_constant_columns(all_points), quantity})
    x_name = quantity.removeprefix(PARAMETER_PREFIX)
    return Curve(label, x_name, group, x, results, maximum, is_complete)


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


def find_peak(x: Sequence[float], y: Sequence[float], y_ci95: Sequence[float | None]) -> Peak:
    """Return the maximum of y over x.

    y_ci95: half-width of the 95 % confidence interval of each y; None if it is unknown

    The interval is that of the vertex of a weighted least-squares parabola. The variance of a value
    is that of its own error plus the misfit of the parabola, which the residuals show.
    Raises ValueError if there are no points.
    """
    order = np.argsort(x)
    xs, ys = _to_array(x)[order], _to_array(y)[order]
    deviations = np.array([(half_width or 0.0) / Z95 for half_width in y_ci95])[order]
    if not len(xs):
        raise ValueError("a curve without points has no maximum")
    top = int(np.argmax(ys))
    first, last = _select_points(ys, top)
    selection = slice(first, last + 1)
    highest = y_ci95[int(order[top])]
    at_edge = top in (0, len(xs) - 1)
    without_parabola = Peak(
        float(xs[top]), None, None, float(ys[top]), highest, at_edge, None, float(xs[top]),
        (float(xs[first]), float(xs[last])),
    )  # fmt: skip
    if at_edge or last - first + 1 < MIN_POINTS:
        return without_parabola
    return _fit_vertex(xs[selection], ys[selection], deviations[selection]) or without_parabola


def _select_points(y: NDArray[np.float64], top: int) -> tuple[int, int]:
    """Return the first and last index of the points of the parabola around the highest point.

    They are above `UPPER_FRACTION` of it, or lower if fewer than `MIN_POINTS` are.
    """
    first = last = top
    limit = UPPER_FRACTION * y[top] if y[top] > 0.0 else y[top]
    while first > 0 and y[first - 1] >= limit:
        first -= 1
    while last < len(y) - 1 and y[last + 1] >= limit:
        last += 1
    while last - first + 1 < min(MIN_POINTS, len(y)):
        left = y[first - 1] if first > 0 else -math.inf
        right = y[last + 1] if last < len(y) - 1 else -math.inf
        first, last = (first - 1, last) if left >= right else (first, last + 1)
    return first, last


def _fit_vertex(
    x: NDArray[np.float64], y: NDArray[np.float64], deviation: NDArray[np.float64]
) -> Peak | None:
    """Return the vertex of the parabola; None if it is not a maximum among the points."""
    centre = float(x.mean())
    matrix = np.vander(x - centre, 3)
    degrees = len(x) - 3
    residuals = y - matrix @ np.linalg.lstsq(matrix, y, rcond=None)[0]
    measurement_variance = float(np.mean(deviation**2))
    misfit_variance = (
        max(0.0, float(residuals @ residuals) / degrees - measurement_variance) if degrees else 0.0
    )
    # Without this, a value that is nearly exact by chance would outweigh all others.
    variance = (
        np.maximum(deviation**2, measurement_variance)
        + misfit_variance
        + (1e-6 * float(np.abs(y).max())) ** 2
    )
    weighted = matrix / variance[:, None]
    covariance = np.linalg.inv(matrix.T @ weighted)
    a, b, c = coefficients = covariance @ (weighted.T @ y)
    if a >= 0.0 or not x[0] - centre <= -b / (2.0 * a) <= x[-1] - centre:
        return None
    offset = float(-b / (2.0 * a))
    slope = np.array([b / (2.0 * a**2), -1.0 / (2.0 * a), 0.0])
    powers = np.array([offset**2, offset, 1.0])
    quantile = student95(degrees) if degrees and misfit_variance > measurement_variance else Z95
    has_interval = degrees > 0 or measurement_variance > 0.0
    x_ci95 = quantile * math.sqrt(slope @ covariance @ slope)
    return Peak(
        x=centre + offset,
        x_ci95_low=max(float(x[0]), centre + offset - x_ci95) if has_interval else None,
        x_ci95_high=min(float(x[-1]), centre + offset + x_ci95) if has_interval else None,
        y=float(powers @ coefficients),
        y_ci95=quantile * math.sqrt(powers @ covariance @ powers) if has_interval else None,
        at_edge=False,
        coefficients=(float(a), float(b), float(c)),
        centre=centre,
        span=(float(x[0]), float(x[-1])),
    )


def _to_array(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)
