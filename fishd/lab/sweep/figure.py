"""Picture of a sweep: values with their error bars, and the best point of each curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, open_figure, plain, save
from fishd.lab.sweep.curves import Curve
from fishd.lab.sweep.results import Quantity

COLOURS = (BLUE, ORANGE, GREEN, PURPLE, BLACK)
MARKERS = "os^Dv<>"
FREQUENCY = "frequency"
MAX_SINGLE_POINTS = 4
"""Largest number of points of a controller without a frequency that are drawn as single points.

They are drawn among the curves over frequencies; more points are drawn as a separate curve.
"""


def draw(
    paths: Sequence[Path],
    curves: Sequence[Curve],
    units: Mapping[str, str],
    *,
    error_of: str,
    quantity: Quantity,
) -> None:
    """Draw the picture into files; the suffix of each chooses its format.

    curves: the curves, at least one of them with a peak. Curves over the same quantity share a
        panel; curves without a quantity or a value are left out. If there are curves over a
        frequency, points without a frequency are drawn at the measured beat frequency.
    units: unit of each quantity on a horizontal axis, by name
    error_of: name of the quantity that the error bars belong to, such as `the mean over beats`
    Raises `FishdError` if a file cannot be written, and `MissingPackage`.
    """
    panels: dict[str, list[Curve]] = {}
    points: list[Curve] = []
    has_frequencies = any(curve.peak and curve.x_name == FREQUENCY for curve in curves)
    for curve in curves:
        if has_frequencies and _has_own_frequency(curve):
            points.append(curve)
        elif curve.peak:
            panels.setdefault(curve.x_name, []).append(curve)
    with open_figure(paths[0], (2.0 + 5.0 * len(panels), 4.2)) as figure:
        panel_axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (x_name, group) in zip(panel_axes, panels.items(), strict=True):
            for index, curve in enumerate(group):
                _draw_curve(
                    axes, curve, COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)]
                )
            if x_name == FREQUENCY:
                _draw_points(axes, points, len(group))
            axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
            unit = units.get(x_name, "")
            axes.set_xlabel(plain(f"{x_name} ({unit})" if unit not in ("", "1") else x_name))
            axes.legend()
        panel_axes[0].set_ylabel(plain(f"{quantity.name} (m{quantity.unit})"))
        note = f"bars: 95 % interval of {error_of}"
        if any(curve.peak and curve.peak.coefficients for curve in curves):
            note += "; cross: maximum of the fitted parabola"
        panel_axes[0].set_title(note, fontsize=8, fontweight="normal", color=GREY)
        for path in paths[1:]:
            save(figure, path)


def _has_own_frequency(curve: Curve) -> bool:
    """Return whether these are a few points, all beating, of a controller without a frequency."""
    return (
        len(curve.points) <= MAX_SINGLE_POINTS
        and not any(FREQUENCY in point.parameters for point in curve.points)
        and all(result.beat_frequency > 0.0 for result in curve.results)
    )


def _draw_curve(axes: Any, curve: Curve, colour: str, marker: str) -> None:
    values = sorted(
        (x, 1e3 * result.value, 1e3 * (result.value_ci95 or 0.0))
        for x, result in zip(curve.x, curve.results, strict=True)
        if result.value is not None
    )
    if not values:
        return
    x, y, error = zip(*values, strict=True)
    axes.errorbar(
        x, y, yerr=error, color=colour, marker=marker, markersize=3.5, linewidth=0.8,
        elinewidth=0.8, capsize=2, label=curve.label,
    )  # fmt: skip
    maximum = curve.peak
    if maximum is None or maximum.coefficients is None:
        return
    x_fit = np.linspace(*maximum.span, 100)
    axes.plot(
        x_fit,
        1e3 * np.polyval(maximum.coefficients, x_fit - maximum.centre),
        color=colour,
        alpha=0.4,
    )
    xerr = [
        [maximum.x - (maximum.x_ci95_low or maximum.x)],
        [(maximum.x_ci95_high or maximum.x) - maximum.x],
    ]
    axes.errorbar(
        maximum.x, 1e3 * maximum.y, xerr=xerr, yerr=1e3 * (maximum.y_ci95 or 0.0), color="black",
        elinewidth=1.2, capsize=0, zorder=5,
    )  # fmt: skip


def _draw_points(axes: Any, curves: Sequence[Curve], used_styles: int) -> None:
    """Draw single points with their names; used: number of colours and markers already in use."""
    style = used_styles
    for curve in curves:
        for point, result in zip(curve.points, curve.results, strict=True):
            if result.value is None:
                continue
            axes.errorbar(
                result.beat_frequency, 1e3 * result.value, yerr=1e3 * (result.value_ci95 or 0.0),
                color=COLOURS[style % len(COLOURS)], marker=MARKERS[style % len(MARKERS)],
                linestyle="", markersize=6, markerfacecolor="white", elinewidth=0.8, capsize=2,
                label=point.label(), zorder=6,
            )  # fmt: skip
            style += 1
