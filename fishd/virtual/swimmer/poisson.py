"""Direct solver of the pressure equation: eigenvectors across, one sweep along for each of them.

This is the fast method for separable equations (Lynch, Rice and Thomas, Numerische Mathematik 6,
1964, doi:10.1007/BF01386067; Swarztrauber, SIAM Review 19, 1977, doi:10.1137/1019071): exact up to
rounding on a stretched grid, at the cost of two matrix products, which are halved on an even grid.
"""

import numpy as np
from numba import njit
from numpy.typing import DTypeLike
from scipy.linalg import eigh_tridiagonal
from threadpoolctl import threadpool_limits

from fishd.virtual.swimmer.grid import Array, Field, Grid


class Poisson:
    """Solver of ∇²φ = f on the cells of a grid: dφ/dn = 0 at three sides, φ = 0 at the right."""

    def __init__(self, grid: Grid, dtype: DTypeLike = np.float64) -> None:
        """dtype: precision of the fields"""
        # Applies to the whole process, intentionally: these matrices are too small for several
        # threads, which wait for each other on a busy machine; a step took ten times as long.
        threadpool_limits(1, "blas")
        across = np.diff(grid.yc)
        upper = 1.0 / across
        diagonal = np.zeros(grid.ny)
        diagonal[:-1] -= upper
        diagonal[1:] -= upper
        # The matrix is symmetric after a scaling with the root of the cells' widths.
        root = np.sqrt(grid.dy)
        values, vectors = eigh_tridiagonal(diagonal / grid.dy, upper / (root[1:] * root[:-1]))
        to_modes, from_modes = root[:, None] * vectors, vectors.T / root[None, :]
        order = np.arange(grid.ny - 1, -1, -1)  # the first mode is constant across
        self._half = 0
        if np.allclose(grid.dy, grid.dy[::-1], rtol=1e-9, atol=0.0):
            # The modes of an even grid alternate between even and odd: the products are halved.
            self._half = (grid.ny + 1) // 2
            order = np.concatenate([order[::2], order[1::2]])
        half = self._half
        values, to_modes, from_modes = values[order], to_modes[:, order], from_modes[order]
        if half:
            # The fold adds the middle row, where there is one, to itself.
            to_modes[half - 1] *= 1.0 if grid.ny % 2 == 0 else 0.5
            to_modes, from_modes = to_modes[:half], from_modes[:, :half]

        def prepared(matrix: Array) -> Field:
            return np.ascontiguousarray(matrix, dtype)

        self._to_modes = prepared(to_modes[:, : half or None])
        self._from_modes = prepared(from_modes[: half or None])
        self._to_odd, self._from_odd = prepared(to_modes[:, half:]), prepared(from_modes[half:])
        self._dx = prepared(grid.dx)
        # Reused, because a new allocation costs as much as one of the products.
        self._even, self._odd = (np.empty((grid.nx, half), dtype) for _ in range(2))
        self._modes, self._solution = (np.empty((grid.nx, grid.ny), dtype) for _ in range(2))
        self._gaps = np.append(np.diff(grid.xc), 0.5 * grid.dx[-1])
        coupling = 1.0 / self._gaps  # φ = 0 half a cell beyond the last centre
        middle = -(coupling + np.append(0.0, coupling[:-1]))
        # Factorisation for each mode of the matrix, which is symmetric before the division by dx.
        pivots = np.empty((grid.nx, grid.ny))
        pivots[0] = middle[0] + values * grid.dx[0]
        for i in range(1, grid.nx):
            pivots[i] = middle[i] + values * grid.dx[i] - coupling[i - 1] ** 2 / pivots[i - 1]
        self._inverse_pivots = prepared(1.0 / pivots)
        self._coupling = prepared(np.append(0.0, coupling[:-1]))

    def solve(self, f: Field) -> Field:
        """Return φ [m² times the unit of f], overwritten by the next call; f: shape (nx, ny)."""
        half = self._half
        modes = self._modes
        if half:
            even, odd = self._even, self._odd
            _fold(f, self._dx, even, odd)
            np.matmul(even, self._to_modes, out=modes[:, :half])
            np.matmul(odd, self._to_odd, out=modes[:, half:])
        else:
            np.matmul(f * self._dx[:, None], self._to_modes, out=modes)
        # In single precision, the recurrence of the constant mode would lose all digits.
        slope = np.cumsum(modes[:, 0], dtype=np.float64) * self._gaps
        constant = -np.cumsum(slope[::-1])[::-1]
        _sweep(modes, self._coupling, self._inverse_pivots)
        modes[:, 0] = constant
        if not half:
            return np.matmul(modes, self._from_modes, out=self._solution)
        np.matmul(modes[:, :half], self._from_modes, out=even)
        np.matmul(modes[:, half:], self._from_odd, out=odd)
        _unfold(even, odd, self._solution)
        return self._solution


@njit(cache=True)
def _fold(f: Field, dx: Field, even: Field, odd: Field) -> None:  # pragma: no cover
    """Compute the even and the odd part across, times the width of the cells."""
    nx, ny = f.shape
    for i in range(nx):
        for j in range(even.shape[1]):
            even[i, j] = dx[i] * (f[i, j] + f[i, ny - 1 - j])
            odd[i, j] = dx[i] * (f[i, j] - f[i, ny - 1 - j])


@njit(cache=True)
def _unfold(even: Field, odd: Field, solution: Field) -> None:  # pragma: no cover
    nx, ny = solution.shape
    for i in range(nx):
        for j in range(even.shape[1]):
            solution[i, ny - 1 - j] = even[i, j] - odd[i, j]
            solution[i, j] = even[i, j] + odd[i, j]


@njit(cache=True, fastmath=True)
def _sweep(values: Field, coupling: Field, inverse_pivots: Field) -> None:  # pragma: no cover
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
