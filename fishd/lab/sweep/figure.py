"""The picture of a sweep: thrust with its error bars, and the best point of each curve."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fishd.core.errors import FishdError
from fishd.lab.sweep.curves import Curve

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#1a1a1a")
MARKERS = "os^Dv<>"


def draw(
    stem: Path, curves: Sequence[Curve], over: str, unit: str, *, error_of: str, force_unit: str
) -> list[Path]:
    """Write the picture as PNG and as SVG; returns both paths.

    stem: path without a suffix
    over: what the curves are drawn over, unit: of that
    error_of: what the bars are, such as `the mean over beats`
    Raises `FishdError` where a file cannot be written.
    """
    with picture(7.0, 4.2) as figure:
        axes = figure.subplots()
        for index, curve in enumerate(curves):
            _draw(axes, curve, COLOURS[index % len(COLOURS)], MARKERS[index % len(MARKERS)])
        axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
        axes.set_xlabel(f"{over} ({unit})" if unit not in ("", "1") else over)
        axes.set_ylabel(f"thrust (m{force_unit})")
        axes.set_title(
            f"bars: 95 % interval of {error_of}; cross: best, of the parabola drawn",
            loc="left",
            fontsize=8,
            color="0.35",
        )
        axes.legend(frameon=False, fontsize=8)
        return save(figure, stem)


@contextmanager
def picture(width: float, height: float) -> Iterator[Any]:
    """A figure of this size [inch], to be drawn and saved while this lasts."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: dict[Any, Any] = {
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "svg.fonttype": "none",
        "svg.hashsalt": "fishd",
    }
    with rc_context(style):
        yield Figure(figsize=(width, height), layout="constrained")


def save(figure: Any, stem: Path) -> list[Path]:
    """Write it as PNG and as SVG; both paths. Raises `FishdError`."""
    paths = [stem.with_name(stem.name + suffix) for suffix in (".png", ".svg")]
    for path in paths:
        try:
            figure.savefig(path, dpi=200, metadata={"Date": None} if ".svg" in path.name else {})
        except OSError as error:
            raise FishdError(f"{path}: the picture cannot be written: {error.strerror}") from None
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
