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
from fishd.virtual.swimmer.threads import Pairs


class Poisson:
    """Solver of ∇²φ = f on the cells of a grid: dφ/dn = 0 at three sides, φ = 0 at the right."""

    def __init__(self, grid: Grid, dtype: DTypeLike = np.float64) -> None:
        """dtype: precision of the fields"""
        # Applies to the whole process, intentionally: these matrices are too small for several
        # threads of BLAS, which wait for each other on a busy machine; a step took ten times as
        # long.
        threadpool_limits(1, "blas")
        self.pairs = Pairs(grid.nx * grid.ny)
        across = np.diff(grid.yc)
        upper = 1.0 / across
        diagonal = np.zeros(grid.ny)
        diagonal[:-1] -= upper
        diagonal[1:] -= upper
        # The matrix is symmetric after a scaling with the root of the cells' widths.
        root = np.sqrt(grid.dy)
        values, vectors = eigh_tridiagonal(diagonal / grid.dy, upper / (root[1:] * root[:-1]))
        to_modes, from_modes = root[:, None] * vectors, vectors.T / root
        # The first mode is constant across.
        values, to_modes, from_modes = values[::-1], to_modes[:, ::-1], from_modes[::-1]
        self._dx = np.asarray(grid.dx, dtype)
        self._solution = np.empty((grid.nx, grid.ny), dtype)
        if np.allclose(grid.dy, grid.dy[::-1], rtol=1e-9, atol=0.0):
            # The modes of an even grid alternate between even and odd: the products are halved.
            half = (grid.ny + 1) // 2
            # The fold adds the middle row, where there is one, to itself.
            to_modes[half - 1] *= 1.0 if grid.ny % 2 == 0 else 0.5
            self._parts = [
                _Modes(grid, values[k::2], to_modes[:half, k::2], from_modes[k::2, :half], dtype)
                for k in (0, 1)
            ]
        else:
            self._parts = [_Modes(grid, values, to_modes, from_modes, dtype)]
        self._parts[0].has_constant = True

    def solve(self, f: Field) -> Field:
        """Return φ [m² times the unit of f], overwritten by the next call; f: shape (nx, ny)."""
        if len(self._parts) == 1:
            part = self._parts[0]
            np.multiply(f, self._dx[:, None], out=part.values)
            part.solve()
            return part.values
        even, odd = self._parts

        def solve(part: _Modes, sign: float) -> None:
            _fold(f, self._dx, sign, part.values)
            part.solve()

        def unfold(rows: slice) -> None:
            _unfold(even.values[rows], odd.values[rows], self._solution[rows])

        self.pairs.run(lambda: solve(even, 1.0), lambda: solve(odd, -1.0))
        middle = len(f) // 2
        self.pairs.run(lambda: unfold(slice(middle)), lambda: unfold(slice(middle, None)))
        return self._solution


class _Modes:
    """Modes across, with the solution of their equations along."""

    def __init__(
        self, grid: Grid, values: Array, to_modes: Array, from_modes: Array, dtype: DTypeLike
    ) -> None:
        """values: eigenvalues [1/m²]; to_modes, from_modes: matrices of the products"""
        self._to_modes = np.ascontiguousarray(to_modes, dtype)
        self._from_modes = np.ascontiguousarray(from_modes, dtype)
        # Reused, because a new allocation costs as much as one of the products.
        self.values = np.empty((grid.nx, to_modes.shape[0]), dtype)
        """f times the width of the cells before `solve`, and φ after it."""
        self.has_constant = False
        """Whether the first mode is constant across."""
        self._modes = np.empty((grid.nx, values.size), dtype)
        self._gaps = np.append(np.diff(grid.xc), 0.5 * grid.dx[-1])
        coupling = 1.0 / self._gaps  # φ = 0 half a cell beyond the last centre
        middle = -(coupling + np.append(0.0, coupling[:-1]))
        # Factorisation for each mode of the matrix, which is symmetric before the division by dx.
        pivots = np.empty((grid.nx, values.size))
        pivots[0] = middle[0] + values * grid.dx[0]
        for i in range(1, grid.nx):
            pivots[i] = middle[i] + values * grid.dx[i] - coupling[i - 1] ** 2 / pivots[i - 1]
        self._inverse_pivots = np.asarray(1.0 / pivots, dtype)
        self._coupling = np.append(0.0, coupling[:-1]).astype(dtype)

    def solve(self) -> None:
        """Replace f in `values` by φ."""
        modes = np.matmul(self.values, self._to_modes, out=self._modes)
        # In single precision, the recurrence of the constant mode would lose all digits.
        slope = np.cumsum(modes[:, 0], dtype=np.float64) * self._gaps
        constant = -np.cumsum(slope[::-1])[::-1]
        _sweep(modes, self._coupling, self._inverse_pivots)
        if self.has_constant:
            modes[:, 0] = constant
        np.matmul(modes, self._from_modes, out=self.values)


@njit(cache=True, fastmath=True, nogil=True)
def _fold(f: Field, dx: Field, sign: float, out: Field) -> None:  # pragma: no cover
    """Compute the even part across, or with the sign −1 the odd part, times the cells' widths."""
    nx, ny = f.shape
    for i in range(nx):
        row, width = f[i], dx[i]
        other = width * f.dtype.type(sign)
        for j in range(out.shape[1]):
            out[i, j] = width * row[j] + other * row[ny - 1 - j]


@njit(cache=True, fastmath=True, nogil=True)
def _unfold(even: Field, odd: Field, solution: Field) -> None:  # pragma: no cover
    nx, ny = solution.shape
    n = even.shape[1]
    for i in range(nx):
        # First the far half, because both write the middle row, where there is one.
        for j in range(n):
            solution[i, ny - 1 - j] = even[i, j] - odd[i, j]
        for j in range(n):
            solution[i, j] = even[i, j] + odd[i, j]


@njit(cache=True, fastmath=True, nogil=True)
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
