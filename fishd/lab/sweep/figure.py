"""The picture of a sweep: values with their error bars, and the best point of each curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, drawn, plain, save
from fishd.lab.sweep.curves import Curve
from fishd.lab.sweep.results import Quantity

COLOURS = (BLUE, ORANGE, GREEN, PURPLE, BLACK)
MARKERS = "os^Dv<>"
FREQUENCY = "frequency"
FEW = 4
"""So many points of a controller that chooses its frequency itself are shown among the curves over
frequencies; more of them are a curve of their own."""


def draw(
    paths: Sequence[Path],
    found: Sequence[Curve],
    units: Mapping[str, str],
    *,
    error_of: str,
    quantity: Quantity,
) -> None:
    """Draw the picture into files; the suffix of each chooses its format.

    found: curves, one with a peak at least; those over one quantity share a panel, and those that
        are over nothing, or without a value, are left out. Where there are curves over a frequency,
        the points of those that have none are shown at the frequency at which the tail beat.
    units: of what they are drawn over
    error_of: what the bars are, such as `the mean over beats`
    Raises `FishdError` where a file cannot be written, and `MissingPackage`.
    """
    panels: dict[str, list[Curve]] = {}
    points: list[Curve] = []
    has_frequencies = any(curve.peak and curve.over == FREQUENCY for curve in found)
    for curve in found:
        if has_frequencies and _chooses_itself(curve):
            points.append(curve)
        elif curve.peak:
            panels.setdefault(curve.over, []).append(curve)
    with drawn(paths[0], (2.0 + 5.0 * len(panels), 4.2)) as figure:
        shown = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (over, curves) in zip(shown, panels.items(), strict=True):
            for index, curve in enumerate(curves):
                _draw(axes, curve, COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)])
            if over == FREQUENCY:
                _draw_points(axes, points, len(curves))
            axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
            unit = units.get(over, "")
            axes.set_xlabel(plain(f"{over} ({unit})" if unit not in ("", "1") else over))
            axes.legend()
        shown[0].set_ylabel(plain(f"{quantity.name} (m{quantity.unit})"))
        note = f"bars: 95 % interval of {error_of}; cross: best, of the parabola drawn"
        shown[0].set_title(note, fontsize=8, fontweight="normal", color=GREY)
        for path in paths[1:]:
            save(figure, path)


def _chooses_itself(curve: Curve) -> bool:
    """Are these a few points of a controller without a frequency, all of which beat the tail?"""
    return (
        len(curve.points) <= FEW
        and not any(FREQUENCY in point.parameters for point in curve.points)
        and all(result.beat_frequency > 0.0 for result in curve.results)
    )


def _draw(axes: Any, curve: Curve, colour: str, marker: str) -> None:
    shown = sorted(
        (x, 1e3 * result.value, 1e3 * (result.error or 0.0))
        for x, result in zip(curve.x, curve.results, strict=True)
        if result.value is not None
    )
    if not shown:
        return
    x, y, error = zip(*shown, strict=True)
    axes.errorbar(
        x, y, yerr=error, color=colour, marker=marker, markersize=3.5, linewidth=0.8,
        elinewidth=0.8, capsize=2, label=curve.label,
    )  # fmt: skip
    best = curve.peak
    if best is None or best.coefficients is None:
        return
    fine = np.linspace(*best.span, 100)
    axes.plot(
        fine, 1e3 * np.polyval(best.coefficients, fine - best.centre), color=colour, alpha=0.4
    )
    xerr = [[best.x - (best.x_low or best.x)], [(best.x_high or best.x) - best.x]]
    axes.errorbar(
        best.x, 1e3 * best.y, xerr=xerr, yerr=1e3 * (best.y_error or 0.0), color="black",
        elinewidth=1.2, capsize=0, zorder=5,
    )  # fmt: skip


def _draw_points(axes: Any, curves: Sequence[Curve], used: int) -> None:
    """Single points, each with its name; used: how many colours and markers are."""
    number = used
    for curve in curves:
        for point, result in zip(curve.points, curve.results, strict=True):
            if result.value is None:
                continue
            axes.errorbar(
                result.beat_frequency, 1e3 * result.value, yerr=1e3 * (result.error or 0.0),
                color=COLOURS[number % len(COLOURS)], marker=MARKERS[number % len(MARKERS)],
                linestyle="", markersize=6, markerfacecolor="white", elinewidth=0.8, capsize=2,
                label=point.label(), zorder=6,
            )  # fmt: skip
            number += 1
