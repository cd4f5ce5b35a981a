"""View of the water around a free swimmer, on square pixels, for pictures and films."""

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.swimmer.feasibility import estimate
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import SwimmerSettings

Array = NDArray[np.float64]
Positions = NDArray[np.floating]
Quantity = Literal["vorticity", "speed", "pressure"]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
UNITS = {"vorticity": "1/s", "speed": "m/s", "pressure": "Pa"}
SIGNED_QUANTITIES = ("vorticity", "pressure")
"""Quantities whose colours are symmetric about 0."""
MAX_LEAD_LENGTHS, BEHIND, BESIDE = 0.9, 2.1, 0.55
"""Distances from the centre of the grid to the edges of the window [body lengths]."""
_ROUND_DIGITS = (1, 2, 3, 5, 10)


class Window(NamedTuple):
    """Rectangle on the grid [m]."""

    left: float
    right: float
    bottom: float
    top: float


class View(NamedTuple):
    """Quantity of the water, and the body in it, at one time, in the laboratory frame."""

    quantity: Quantity
    values: Array
    """Values in the unit of the quantity, shape (rows, columns), the lowest row first."""
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


def window_around(settings: SwimmerSettings) -> Window:
    """Return the window of the fish and the wake behind it, within the tank."""
    length, water = settings.body.length, settings.water
    return Window(
        max(-MAX_LEAD_LENGTHS * length, -0.5 * water.length),
        min(BEHIND * length, 0.5 * water.length),
        max(-BESIDE * length, -0.5 * water.width),
        min(BESIDE * length, 0.5 * water.width),
    )


def whole_window(settings: SwimmerSettings) -> Window:
    """Return the window of the whole tank."""
    length, width = 0.5 * settings.water.length, 0.5 * settings.water.width
    return Window(-length, length, -width, width)


def take_view(fish: Fish, quantity: Quantity, window: Window, columns: int) -> View:
    """Return the view through a window of the grid; columns: its width in pixels."""
    pixel = (window.right - window.left) / columns
    rows = max(1, round((window.top - window.bottom) / pixel))
    x = window.left + pixel * (np.arange(columns) + 0.5)
    y = window.bottom + (window.top - window.bottom) / rows * (np.arange(rows) + 0.5)
    values, at_x, at_y = _read_quantity(fish, quantity)
    offset = fish.travelled
    motion = fish.motion()
    return View(
        quantity,
        _interpolate(values, at_x, at_y, x, y).T,
        Window(window.left + offset, window.right + offset, window.bottom, window.top),
        fish.outline() + np.array([offset, 0.0]),
        motion.time,
        motion.speed,
        motion.x,
    )


def choose_colour_limit(settings: SwimmerSettings, quantity: Quantity) -> float:
    """Return the value at which the colours end: a round number, the same for all views.

    It is computed from the expected speed of the tail and a wake thickness of about 0.1 L.
    """
    body, water = settings.body, settings.water
    expected = estimate(settings)
    tail = 2.0 * math.pi * expected.frequency * expected.deflection
    largest = {
        "vorticity": tail / (0.1 * body.length),
        "speed": 0.7 * tail,
        "pressure": 0.25 * water.density * tail**2,
    }[quantity]
    return round_number(largest)


def round_number(value: float) -> float:
    """Return the nearest of 1, 2, 3, 5 times a power of ten; 1 unless the value is positive."""
    if not (value > 0.0 and math.isfinite(value)):
        return 1.0
    power = math.floor(math.log10(value))
    choices = [float(f"{digit}e{power}") for digit in _ROUND_DIGITS]
    return min(choices, key=lambda choice: abs(math.log(choice / value)))


def _read_quantity(fish: Fish, quantity: Quantity) -> tuple[Array, Array, Array]:
    """Return values, shape (nx, ny), and their x and y coordinates on the grid [m]."""
    flow = fish.flow
    grid = flow.grid
    if quantity == "vorticity":
        return flow.vorticity(), grid.x[1:-1], grid.y[1:-1]
    if quantity == "pressure":
        return fish.settings.water.density * flow.p, grid.xc, grid.yc
    u, v = 0.5 * (flow.u[1:] + flow.u[:-1]), 0.5 * (flow.v[:, 1:] + flow.v[:, :-1])
    return np.hypot(u, v), grid.xc, grid.yc


def _interpolate(values: Array, at_x: Array, at_y: Array, x: Positions, y: Positions) -> Array:
    """Return bilinear interpolations of a grid; beyond its ends, the values at the ends."""
    i, s = _locate(at_x, x)
    j, t = _locate(at_y, y)
    s, t = s[:, None], t[None, :]
    left = (1.0 - t) * values[np.ix_(i, j)] + t * values[np.ix_(i, j + 1)]
    right = (1.0 - t) * values[np.ix_(i + 1, j)] + t * values[np.ix_(i + 1, j + 1)]
    return np.asarray((1.0 - s) * left + s * right)


def _locate(nodes: Array, places: Positions) -> tuple[NDArray[np.intp], Positions]:
    """Return the node before each position, and the fraction of the way to the next, 0 to 1."""
    first = np.clip(np.searchsorted(nodes, places) - 1, 0, len(nodes) - 2)
    share = (places - nodes[first]) / (nodes[first + 1] - nodes[first])
    return first, np.clip(share, 0.0, 1.0)
