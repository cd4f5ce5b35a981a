"""The picture of a sweep: thrust with its error bars, and the best point of each curve."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, drawn, save
from fishd.lab.sweep.curves import Curve

COLOURS = (BLUE, ORANGE, GREEN, PURPLE, BLACK)
MARKERS = "os^Dv<>"


def draw(
    stem: Path,
    found: Sequence[Curve],
    units: Mapping[str, str],
    *,
    error_of: str,
    force_unit: str,
) -> list[Path]:
    """Write the picture as PNG and as SVG; returns both paths.

    stem: path without a suffix
    found: curves, one with a peak at least; those over one quantity share a panel, and those that
        are over nothing, or without a thrust, are left out
    units: of what they are drawn over
    error_of: what the bars are, such as `the mean over beats`
    Raises `FishdError` where a file cannot be written, and `MissingPackage`.
    """
    panels: dict[str, list[Curve]] = {}
    for curve in found:
        if curve.peak:
            panels.setdefault(curve.over, []).append(curve)
    paths = [stem.with_name(stem.name + suffix) for suffix in (".png", ".svg")]
    with drawn(paths[0], (2.0 + 5.0 * len(panels), 4.2)) as figure:
        shown = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (over, curves) in zip(shown, panels.items(), strict=True):
            for index, curve in enumerate(curves):
                _draw(axes, curve, COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)])
            axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
            unit = units.get(over, "")
            axes.set_xlabel(f"{over} ({unit})" if unit not in ("", "1") else over)
            axes.legend()
        shown[0].set_ylabel(f"thrust (m{force_unit})")
        note = f"bars: 95 % interval of {error_of}; cross: best, of the parabola drawn"
        shown[0].set_title(note, fontsize=8, fontweight="normal", color=GREY)
        save(figure, paths[1])
    return paths


def _draw(axes: Any, curve: Curve, colour: str, marker: str) -> None:
    shown = sorted(
        (x, 1e3 * result.thrust, 1e3 * (result.error or 0.0))
        for x, result in zip(curve.x, curve.results, strict=True)
        if result.thrust is not None
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
