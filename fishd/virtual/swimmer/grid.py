"""Cartesian grid: cells of one size around the body, stretched towards the ends of the tank."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Field = NDArray[np.floating]
"""Values on the grid, of single or double precision."""
MAX_SIZE_RATIO = 1.001
"""Largest ratio of the sizes of cells that count as equal."""


class Grid:
    """Edges, centres and sizes of the cells of a staggered (MAC) grid.

    Pressures are at cell centres, velocities on the faces: u, shape (nx + 1, ny), on the faces
    normal to x, and v, shape (nx, ny + 1), on those normal to y (Harlow and Welch, Phys. Fluids 8,
    1965, doi:10.1063/1.1761178).
    """

    def __init__(self, x: Array, y: Array) -> None:
        """x, y: edges of the cells, ascending; shapes (nx + 1,) and (ny + 1,) [m]"""
        self.x, self.y = x, y
        self.dx, self.dy = np.diff(x), np.diff(y)
        self.xc, self.yc = 0.5 * (x[1:] + x[:-1]), 0.5 * (y[1:] + y[:-1])
        self.nx, self.ny = len(self.dx), len(self.dy)
        self.h = float(min(self.dx.min(), self.dy.min()))
        """Size of the cells around the body [m]."""

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.nx * self.ny


def edges(low: float, high: float, fine: tuple[float, float], h: float, ratio: float) -> Array:
    """Return the edges of cells from `low` to `high`, of size h between `fine`, growing outside.

    ratio: largest ratio of the sizes of adjacent cells outside
    The fine part is extended to whole cells, and the ratio is reduced so that whole cells fit.
    Where that would make cells smaller than h, there is one cell less, and the ratio is larger.
    """
    count = max(1, math.ceil((fine[1] - fine[0]) / h - 1e-9))
    middle = 0.5 * (fine[0] + fine[1])
    inner = middle + h * (np.arange(count + 1) - 0.5 * count)
    left = _stretch_edges(inner[0] - low, h, ratio)
    right = _stretch_edges(high - inner[-1], h, ratio)
    return np.concatenate([inner[0] - left[::-1], inner, inner[-1] + right])


def _stretch_edges(length: float, h: float, ratio: float) -> Array:
    """Return the distances of edges from the fine part; the last is `length`; empty if short."""
    if length < 0.5 * h:
        return np.empty(0)
    if ratio <= 1.0 or length <= h:
        count = max(1, round(length / h))
        if count > 1 and count * h > MAX_SIZE_RATIO * length:
            count -= 1
        return np.linspace(length / count, length, count)
    count = math.ceil(math.log1p((ratio - 1.0) * length / (h * ratio)) / math.log(ratio))
    low, high = 1.0, ratio
    if count * h > MAX_SIZE_RATIO * length:
        count, high = count - 1, 2.0
    for _ in range(60):  # bisection for the ratio at which `count` cells have this length
        middle = 0.5 * (low + high)
        if h * sum(middle**k for k in range(1, count + 1)) > length:
            high = middle
        else:
            low = middle
    distances = np.cumsum(h * low ** np.arange(1, count + 1))
    return np.asarray(distances * (length / distances[-1]))
