"""The pressure equation, solved directly: eigenvectors across, one sweep along for each of them.

The fast method for separable equations (Lynch, Rice and Thomas, Numerische Mathematik 6, 1964,
doi:10.1007/BF01386067; Swarztrauber, SIAM Review 19, 1977, doi:10.1137/1019071): exact to rounding
on a stretched grid, at the price of two matrix products.
"""

import numpy as np
from numba import njit
from scipy.linalg import eigh_tridiagonal
from threadpoolctl import threadpool_limits

from fishd.swimmer.grid import Array, Grid


class Poisson:
    """Solves ∇²φ = f on the cells of a grid: dφ/dn = 0 at three sides, φ = 0 at the right one."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        # For the whole process, and on purpose: these matrices are too small for several threads,
        # which on a busy machine wait for each other, and made a step ten times longer.
        threadpool_limits(1, "blas")
        across = np.diff(grid.yc)
        upper = 1.0 / across
        diagonal = np.zeros(grid.ny)
        diagonal[:-1] -= upper
        diagonal[1:] -= upper
        # Symmetric after a scaling with the root of the cells' widths.
        root = np.sqrt(grid.dy)
        values, vectors = eigh_tridiagonal(diagonal / grid.dy, upper / (root[1:] * root[:-1]))
        self._to_modes = np.ascontiguousarray(root[:, None] * vectors)
        self._from_modes = np.ascontiguousarray(vectors.T / root[None, :])
        along = np.diff(grid.xc)
        lower = np.zeros(grid.nx)
        higher = np.zeros(grid.nx)
        lower[1:] = 1.0 / along
        higher[:-1] = 1.0 / along
        middle = -(lower + higher)
        middle[-1] -= 2.0 / grid.dx[-1]  # φ = 0 half a cell further on
        # A factorisation for each mode, of the matrix that is symmetric before the division by dx.
        pivots = np.empty((grid.nx, grid.ny))
        pivots[0] = middle[0] + values * grid.dx[0]
        for i in range(1, grid.nx):
            pivots[i] = middle[i] + values * grid.dx[i] - lower[i] ** 2 / pivots[i - 1]
        self._inverse_pivots = 1.0 / pivots
        self._coupling = lower

    def solve(self, f: Array) -> Array:
        """φ [m² times the unit of f]; f: shape (nx, ny)."""
        modes = (f * self._grid.dx[:, None]) @ self._to_modes
        _sweep(modes, self._coupling, self._inverse_pivots)
        return np.asarray(modes @ self._from_modes)


@njit(cache=True, fastmath=True)
def _sweep(values: Array, coupling: Array, inverse_pivots: Array) -> None:  # pragma: no cover
    nx, ny = values.shape
    for i in range(1, nx):
        c = coupling[i]
        for j in range(ny):
            values[i, j] -= c * inverse_pivots[i - 1, j] * values[i - 1, j]
    for j in range(ny):
        values[nx - 1, j] *= inverse_pivots[nx - 1, j]
    for i in range(nx - 2, -1, -1):
        c = coupling[i + 1]
        for j in range(ny):
            values[i, j] = (values[i, j] - c * values[i + 1, j]) * inverse_pivots[i, j]
