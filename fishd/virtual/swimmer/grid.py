"""A Cartesian grid: cells of one size around the body, stretched towards the ends of the tank."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SAME = 1.001
"""Cells are of one size where none is larger than another by more than this factor."""


class Grid:
    """Edges, centres and sizes of the cells of a staggered (MAC) grid.

    Pressures lie at cell centres, velocities on the faces: u, of shape (nx + 1, ny), on the faces
    across x, v, of shape (nx, ny + 1), on those across y (Harlow and Welch, Phys. Fluids 8, 1965,
    doi:10.1063/1.1761178).
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
        """How many cells there are."""
        return self.nx * self.ny


def edges(low: float, high: float, fine: tuple[float, float], h: float, ratio: float) -> Array:
    """Edges of cells from `low` to `high`: of size h between `fine`, and growing outside of it.

    ratio: of neighbouring cells outside, at most
    The fine part is widened to whole cells, and the ratio lowered so that whole cells fit. Where
    that would make them smaller than h, there is one less, and the ratio is larger.
    """
    count = max(1, math.ceil((fine[1] - fine[0]) / h - 1e-9))
    middle = 0.5 * (fine[0] + fine[1])
    inner = middle + h * (np.arange(count + 1) - 0.5 * count)
    left = _stretched(inner[0] - low, h, ratio)
    right = _stretched(high - inner[-1], h, ratio)
    return np.concatenate([inner[0] - left[::-1], inner, inner[-1] + right])


def _stretched(length: float, h: float, ratio: float) -> Array:
    """Distances of edges from the fine part, the last one `length` or, if that is none, empty."""
    if length < 0.5 * h:
        return np.empty(0)
    if ratio <= 1.0 or length <= h:
        count = max(1, round(length / h))
        if count > 1 and count * h > SAME * length:
            count -= 1
        return np.linspace(length / count, length, count)
    count = math.ceil(math.log1p((ratio - 1.0) * length / (h * ratio)) / math.log(ratio))
    low, high = 1.0, ratio
    if count * h > SAME * length:
        count, high = count - 1, 2.0
    for _ in range(60):  # the ratio with which `count` cells are just as long
        middle = 0.5 * (low + high)
        if h * sum(middle**k for k in range(1, count + 1)) > length:
            high = middle
        else:
            low = middle
    distances = np.cumsum(h * low ** np.arange(1, count + 1))
    return np.asarray(distances * (length / distances[-1]))
