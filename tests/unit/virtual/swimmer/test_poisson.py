"""Exact solution of the pressure equation, of second order."""

import numpy as np
import pytest

from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.poisson import Poisson


def laplacian(grid: Grid, phi: Array) -> Array:
    """Return ∇²φ of the cells, with φ = 0 at the right side and dφ/dn = 0 at the others."""
    along = np.zeros((grid.nx + 1, grid.ny))
    along[1:-1] = np.diff(phi, axis=0) / np.diff(grid.xc)[:, None]
    along[-1] = -2.0 * phi[-1] / grid.dx[-1]
    across = np.zeros((grid.nx, grid.ny + 1))
    across[:, 1:-1] = np.diff(phi, axis=1) / np.diff(grid.yc)
    return np.diff(along, axis=0) / grid.dx[:, None] + np.diff(across, axis=1) / grid.dy


@pytest.mark.parametrize("middle", [0.5, 0.4])
@pytest.mark.parametrize("cell", [0.02, 0.021])
def test_it_solves_to_rounding_on_a_stretched_grid(middle: float, cell: float) -> None:
    fine = middle - 0.1, middle + 0.1
    grid = Grid(edges(0.0, 2.0, (0.8, 1.2), 0.02, 1.1), edges(0.0, 1.0, fine, cell, 1.1))
    phi = np.random.default_rng(1).normal(size=(grid.nx, grid.ny))
    assert Poisson(grid).solve(laplacian(grid, phi)) == pytest.approx(phi, abs=1e-10)


@pytest.mark.parametrize("rows", [3, 4, 7, 16])
def test_even_and_odd_numbers_of_cells_across_are_alike(rows: int) -> None:
    grid = Grid(np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, rows + 1))
    phi = np.random.default_rng(2).normal(size=(8, rows))
    assert Poisson(grid).solve(laplacian(grid, phi)) == pytest.approx(phi, abs=1e-12)


def error(cells: int) -> float:
    """Return the largest error of a smooth solution."""
    grid = Grid(np.linspace(0.0, 2.0, 2 * cells + 1), np.linspace(0.0, 1.0, cells + 1))
    a, b = 0.25 * np.pi, 2.0 * np.pi
    phi = np.cos(a * grid.xc)[:, None] * np.cos(b * grid.yc)
    return float(np.abs(Poisson(grid).solve(-(a * a + b * b) * phi) - phi).max())


def test_halving_the_cells_quarters_the_error() -> None:
    assert error(16) / error(32) == pytest.approx(4.0, rel=0.05)
