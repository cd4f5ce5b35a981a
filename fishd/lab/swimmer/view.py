"""The water around a free swimmer on square pixels: what its pictures and films show."""

import math
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.swimmer.feasibility import estimate
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import SwimmerSettings

Array = NDArray[np.float64]
Places = NDArray[np.floating]
Quantity = Literal["vorticity", "speed", "pressure"]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
UNITS = {"vorticity": "1/s", "speed": "m/s", "pressure": "Pa"}
SIGNED = ("vorticity", "pressure")
"""These are shown with colours that are symmetric about 0."""
AHEAD, BEHIND, BESIDE = 0.9, 2.1, 0.55
"""What is shown, from the middle of the grid, in lengths of the fish: most of it is wake."""
_ROUND = (1, 2, 3, 5, 10)


class Window(NamedTuple):
    """A rectangle on the grid [m]."""

    left: float
    right: float
    bottom: float
    top: float


class View(NamedTuple):
    """A quantity of the water and the body in it, at an instant, in the laboratory."""

    quantity: Quantity
    values: Array
    """Shape (rows, columns), the lowest row first; in the unit of the quantity."""
    window: Window
    """In the laboratory [m]."""
    outline: Array
    """The surface of the body in the laboratory, shape (points, 2) [m]."""
    time: float
    """[s]"""
    speed: float
    """Of the fish, forwards [m/s]."""
    x: float
    """Where its centre of mass is in the laboratory; it swims towards −x [m]."""


def around(settings: SwimmerSettings) -> Window:
    """The fish and the wake behind it, as far as the tank reaches."""
    length, water = settings.body.length, settings.water
    return Window(
        max(-AHEAD * length, -0.5 * water.length),
        min(BEHIND * length, 0.5 * water.length),
        max(-BESIDE * length, -0.5 * water.width),
        min(BESIDE * length, 0.5 * water.width),
    )


def whole(settings: SwimmerSettings) -> Window:
    """The whole tank."""
    length, width = 0.5 * settings.water.length, 0.5 * settings.water.width
    return Window(-length, length, -width, width)


def view(fish: Fish, quantity: Quantity, window: Window, columns: int) -> View:
    """What is seen through a window of the grid that is so many pixels wide."""
    pixel = (window.right - window.left) / columns
    rows = max(1, round((window.top - window.bottom) / pixel))
    x = window.left + pixel * (np.arange(columns) + 0.5)
    y = window.bottom + (window.top - window.bottom) / rows * (np.arange(rows) + 0.5)
    values, at_x, at_y = _field(fish, quantity)
    offset = fish.travelled
    motion = fish.motion()
    return View(
        quantity,
        _sampled(values, at_x, at_y, x, y).T,
        Window(window.left + offset, window.right + offset, window.bottom, window.top),
        fish.outline() + np.array([offset, 0.0]),
        motion.time,
        motion.speed,
        motion.x,
    )


def scale(settings: SwimmerSettings, quantity: Quantity) -> float:
    """The value at which the colours end, a round one: for all pictures of this fish alike.

    It follows from how fast the tail is expected to move, and how thick its wake is, 0.1 L or so.
    """
    body, water = settings.body, settings.water
    expected = estimate(settings)
    tail = 2.0 * math.pi * expected.frequency * expected.deflection
    largest = {
        "vorticity": tail / (0.1 * body.length),
        "speed": 0.7 * tail,
        "pressure": 0.25 * water.density * tail**2,
    }[quantity]
    return rounded(largest)


def rounded(value: float) -> float:
    """The nearest of 1, 2, 3, 5 times a power of ten; 1 for what is no positive number."""
    if not (value > 0.0 and math.isfinite(value)):
        return 1.0
    power = math.floor(math.log10(value))
    choices = [float(f"{digit}e{power}") for digit in _ROUND]
    return min(choices, key=lambda each: abs(math.log(each / value)))


def _field(fish: Fish, quantity: Quantity) -> tuple[Array, Array, Array]:
    """Values, shape (nx, ny), and the places of their columns and rows on the grid [m]."""
    flow = fish.flow
    grid = flow.grid
    if quantity == "vorticity":
        return flow.vorticity(), grid.x[1:-1], grid.y[1:-1]
    if quantity == "pressure":
        return fish.settings.water.density * flow.p, grid.xc, grid.yc
    u, v = 0.5 * (flow.u[1:] + flow.u[:-1]), 0.5 * (flow.v[:, 1:] + flow.v[:, :-1])
    return np.hypot(u, v), grid.xc, grid.yc


def _sampled(values: Array, at_x: Array, at_y: Array, x: Places, y: Places) -> Array:
    """Values between those of a grid, bilinear; beyond its ends, those at the ends."""
    i, s = _between(at_x, x)
    j, t = _between(at_y, y)
    s, t = s[:, None], t[None, :]
    left = (1.0 - t) * values[np.ix_(i, j)] + t * values[np.ix_(i, j + 1)]
    right = (1.0 - t) * values[np.ix_(i + 1, j)] + t * values[np.ix_(i + 1, j + 1)]
    return np.asarray((1.0 - s) * left + s * right)


def _between(nodes: Array, places: Places) -> tuple[NDArray[np.intp], Places]:
    """The node before each place, and how far it is from there to the next one, 0 to 1."""
    first = np.clip(np.searchsorted(nodes, places) - 1, 0, len(nodes) - 2)
    share = (places - nodes[first]) / (nodes[first + 1] - nodes[first])
    return first, np.clip(share, 0.0, 1.0)
