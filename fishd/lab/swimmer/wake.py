"""Vorticity of the water around a free swimmer, on square pixels, for pictures and films."""

import math
import os
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interpn

from fishd.lab.drawing import BLACK, open_figure
from fishd.virtual.swimmer.checkpoint import Checkpoint, CheckpointError
from fishd.virtual.swimmer.feasibility import estimate
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import SwimmerSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Positions = NDArray[np.floating]
MAX_LEAD_LENGTHS, BEHIND, BESIDE = 0.9, 2.1, 0.55
"""Distances from the centre of the grid to the edges of the window [body lengths]."""
_ROUND_DIGITS = (1, 2, 3, 5, 10)
COLUMNS = 1200
"""Width of the water in a picture [pixels]."""
COLOURS = "RdBu_r"
"""Colour map, which is symmetric about 0."""
BODY_COLOUR = "0.25"
_WIDTH_IN = 7.2
_SIDE_MARGIN_IN = 1.35
_TOP_MARGIN_IN = 0.75


class Window(NamedTuple):
    """Rectangle on the grid [m]."""

    left: float
    right: float
    bottom: float
    top: float


class View(NamedTuple):
    """Vorticity of the water, and the body in it, at one time, in the laboratory frame."""

    vorticity: Array
    """Shape (rows, columns), the lowest row first [1/s]."""
    window: Window
    """Window in the laboratory frame [m]."""
    outline: Array
    """Surface of the body in the laboratory frame, shape (points, 2) [m]."""
    time: float
    """Time of the view [s]."""
    speed: float
    """Forward speed of the fish [m/s]."""
    x: float
    """Position of its centre of mass in the laboratory frame; it swims towards −x [m]."""


def restore_fish(checkpoint: Checkpoint) -> Fish:
    """Return the fish of a checkpoint, in the state of the checkpoint; raises `CheckpointError`."""
    try:
        settings = msgspec.convert(checkpoint.settings["swimmer"], SwimmerSettings)
        fish = Fish(settings)
        checkpoint.check_state(fish.state())
        fish.restore(checkpoint.state)
    except (KeyError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint.path}: it was written by an incompatible version of fishd ({error})"
        ) from None
    return fish


def window_around(settings: SwimmerSettings) -> Window:
    """Return the window of the fish and the wake behind it, within the tank."""
    length, water = settings.body.length, settings.water
    return Window(
        max(-MAX_LEAD_LENGTHS * length, -0.5 * water.length),
        min(BEHIND * length, 0.5 * water.length),
        max(-BESIDE * length, -0.5 * water.width),
        min(BESIDE * length, 0.5 * water.width),
    )


def take_view(fish: Fish, window: Window, columns: int) -> View:
    """Return the view through a window of the grid; columns: its width in pixels."""
    pixel = (window.right - window.left) / columns
    rows = max(1, round((window.top - window.bottom) / pixel))
    x = window.left + pixel * (np.arange(columns) + 0.5)
    y = window.bottom + (window.top - window.bottom) / rows * (np.arange(rows) + 0.5)
    grid = fish.flow.grid
    along, across = fish.travelled
    motion = fish.motion()
    return View(
        _interpolate(fish.flow.vorticity(), grid.x[1:-1], grid.y[1:-1], x, y).T,
        Window(
            window.left + along, window.right + along, window.bottom + across, window.top + across
        ),
        fish.outline() + fish.travelled,
        motion.time,
        motion.speed,
        motion.x,
    )


def choose_colour_limit(settings: SwimmerSettings) -> float:
    """Return the vorticity at which the colours end [1/s]: a round number, the same for all views.

    It is computed from the expected speed of the tail and a wake thickness of about 0.1 L.
    """
    expected = estimate(settings)
    tail = 2.0 * math.pi * expected.frequency * expected.deflection
    return round_number(tail / (0.1 * settings.body.length))


def round_number(value: float) -> float:
    """Return the nearest of 1, 2, 3, 5 times a power of ten; 1 unless the value is positive."""
    if not (value > 0.0 and math.isfinite(value)):
        return 1.0
    power = math.floor(math.log10(value))
    choices = [float(f"{digit}e{power}") for digit in _ROUND_DIGITS]
    return min(choices, key=lambda choice: abs(math.log(choice / value)))


def _interpolate(values: Array, at_x: Array, at_y: Array, x: Positions, y: Positions) -> Array:
    """Return bilinear interpolations of a grid; beyond its ends, the values at the ends."""
    places = np.clip(x, at_x[0], at_x[-1]), np.clip(y, at_y[0], at_y[-1])
    return np.asarray(interpn((at_x, at_y), values, tuple(np.meshgrid(*places, indexing="ij"))))


def draw_wake(scene: View, limit: float, path: str | os.PathLike[str]) -> None:
    """Write the picture as PNG, PDF or SVG; raises `FishdError` and `MissingPackage`.

    limit: vorticity at which the colours end [1/s]
    """
    window = scene.window
    height = (
        (_WIDTH_IN - _SIDE_MARGIN_IN) * (window.top - window.bottom) / (window.right - window.left)
    )
    with open_figure(path, (_WIDTH_IN, height + _TOP_MARGIN_IN)) as figure:
        axes = figure.subplots()
        image = axes.imshow(
            scene.vorticity,
            origin="lower",
            extent=(
                100.0 * window.left,
                100.0 * window.right,
                100.0 * window.bottom,
                100.0 * window.top,
            ),
            cmap=COLOURS,
            vmin=-limit,
            vmax=limit,
            interpolation="bilinear",
        )
        axes.fill(*(100.0 * scene.outline).T, color=BODY_COLOUR, linewidth=0.0)
        axes.set_xlim(100.0 * window.left, 100.0 * window.right)
        axes.set_ylim(100.0 * window.bottom, 100.0 * window.top)
        axes.set_xlabel("x (cm)")
        axes.set_ylabel("y (cm)")
        axes.set_title(
            f"vorticity at {scene.time:.2f} s; the fish swims to the left with "
            f"{1e3 * scene.speed:.1f} mm/s",
            fontweight="normal",
        )
        extend = _find_exceeded_ends(scene, limit)
        bar_axes = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
        bar = figure.colorbar(image, cax=bar_axes, extend=extend)
        bar.set_label("vorticity (1/s)")
        _draw_scale_bar(axes, window)


def _find_exceeded_ends(scene: View, limit: float) -> str:
    """Return the ends of the colour bar that values exceed, as matplotlib names them."""
    low = float(np.min(scene.vorticity)) < -limit
    high = float(np.max(scene.vorticity)) > limit
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
