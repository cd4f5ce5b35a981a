"""Pictures of the water around a free swimmer: vorticity, speed or pressure, and the body in it."""

import os
from typing import TYPE_CHECKING

import numpy as np

from fishd.lab.drawing import BLACK, drawn
from fishd.lab.swimmer.view import SIGNED, UNITS, View, Window, rounded

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = 1200
"""Pixels across such a picture."""
COLOURS = {"vorticity": "RdBu_r", "speed": "YlGnBu", "pressure": "PuOr_r"}
BODY = "0.25"
_WIDTH = 7.2
_BESIDE = 1.35
_ABOVE = 0.75


def picture(shown: View, limit: float, path: str | os.PathLike[str]) -> None:
    """Write it as PNG, PDF or SVG; raises `FishdError` where that cannot be, `MissingPackage`.

    limit: the value at which the colours end
    """
    window = shown.window
    tall = (_WIDTH - _BESIDE) * (window.top - window.bottom) / (window.right - window.left)
    with drawn(path, (_WIDTH, tall + _ABOVE)) as figure:
        axes = figure.subplots()
        image = axes.imshow(
            shown.values,
            origin="lower",
            extent=(
                100.0 * window.left,
                100.0 * window.right,
                100.0 * window.bottom,
                100.0 * window.top,
            ),
            cmap=COLOURS[shown.quantity],
            vmin=-limit if shown.quantity in SIGNED else 0.0,
            vmax=limit,
            interpolation="bilinear",
        )
        axes.fill(*(100.0 * shown.outline).T, color=BODY, linewidth=0.0)
        axes.set_xlim(100.0 * window.left, 100.0 * window.right)
        axes.set_ylim(100.0 * window.bottom, 100.0 * window.top)
        axes.set_xlabel("x (cm)")
        axes.set_ylabel("y (cm)")
        axes.set_title(
            f"{shown.quantity} at {shown.time:.2f} s; the fish swims to the left with "
            f"{1e3 * shown.speed:.1f} mm/s",
            fontweight="normal",
        )
        extend = _beyond(shown, limit)
        beside = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
        bar = figure.colorbar(image, cax=beside, extend=extend)
        bar.set_label(f"{shown.quantity} ({UNITS[shown.quantity]})")
        _scale_bar(axes, window)


def _beyond(shown: View, limit: float) -> str:
    """Where values are beyond the ends of the colours."""
    low = shown.quantity in SIGNED and float(np.min(shown.values)) < -limit
    high = float(np.max(shown.values)) > limit
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[low, high]


def _scale_bar(axes: "Axes", window: Window) -> None:
    width, height = window.right - window.left, window.top - window.bottom
    length = rounded(0.12 * width)
    right, low = window.right - 0.03 * width, window.bottom + 0.06 * height
    axes.plot(
        [100.0 * (right - length), 100.0 * right],
        [100.0 * low] * 2,
        color=BLACK,
        linewidth=2.0,
        solid_capstyle="butt",
    )
    axes.text(
        100.0 * (right - 0.5 * length),
        100.0 * (low + 0.03 * height),
        f"{100.0 * length:g} cm",
        ha="center",
        va="bottom",
        fontsize=8,
        color=BLACK,
    )
