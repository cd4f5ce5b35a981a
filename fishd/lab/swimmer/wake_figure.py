"""Pictures of the water around a free swimmer: vorticity, speed or pressure, and the body in it."""

import os
from typing import TYPE_CHECKING

import numpy as np

from fishd.lab.drawing import BLACK, open_figure
from fishd.lab.swimmer.view import SIGNED_QUANTITIES, UNITS, View, Window, round_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = 1200
"""Width of the water in a draw_wake [pixels]."""
COLOURS = {"vorticity": "RdBu_r", "speed": "YlGnBu", "pressure": "PuOr_r"}
BODY_COLOUR = "0.25"
_WIDTH_IN = 7.2
_SIDE_MARGIN_IN = 1.35
_TOP_MARGIN_IN = 0.75


def draw_wake(scene: View, limit: float, path: str | os.PathLike[str]) -> None:
    """Write the draw_wake as PNG, PDF or SVG; raises `FishdError` and `MissingPackage`.

    limit: value at which the colours end
    """
    window = scene.window
    height = (
        (_WIDTH_IN - _SIDE_MARGIN_IN) * (window.top - window.bottom) / (window.right - window.left)
    )
    with open_figure(path, (_WIDTH_IN, height + _TOP_MARGIN_IN)) as figure:
        axes = figure.subplots()
        image = axes.imshow(
            scene.values,
            origin="lower",
            extent=(
                100.0 * window.left,
                100.0 * window.right,
                100.0 * window.bottom,
                100.0 * window.top,
            ),
            cmap=COLOURS[scene.quantity],
            vmin=-limit if scene.quantity in SIGNED_QUANTITIES else 0.0,
            vmax=limit,
            interpolation="bilinear",
        )
        axes.fill(*(100.0 * scene.outline).T, color=BODY_COLOUR, linewidth=0.0)
        axes.set_xlim(100.0 * window.left, 100.0 * window.right)
        axes.set_ylim(100.0 * window.bottom, 100.0 * window.top)
        axes.set_xlabel("x (cm)")
        axes.set_ylabel("y (cm)")
        axes.set_title(
            f"{scene.quantity} at {scene.time:.2f} s; the fish swims to the left with "
            f"{1e3 * scene.speed:.1f} mm/s",
            fontweight="normal",
        )
        extend = _find_exceeded_ends(scene, limit)
        bar_axes = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
        bar = figure.colorbar(image, cax=bar_axes, extend=extend)
        bar.set_label(f"{scene.quantity} ({UNITS[scene.quantity]})")
        _draw_scale_bar(axes, window)


def _find_exceeded_ends(scene: View, limit: float) -> str:
    """Return the ends of the colour bar that values exceed, as matplotlib names them."""
    low = scene.quantity in SIGNED_QUANTITIES and float(np.min(scene.values)) < -limit
    high = float(np.max(scene.values)) > limit
    return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[low, high]


def _draw_scale_bar(axes: "Axes", window: Window) -> None:
    width, height = window.right - window.left, window.top - window.bottom
    length = round_number(0.12 * width)
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
