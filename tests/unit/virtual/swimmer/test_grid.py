"""Grid with small cells in its fine part, growing slowly towards the ends."""

import numpy as np
import pytest

from fishd.virtual.swimmer.grid import MAX_SIZE_RATIO, Grid, edges


def test_cells_are_small_where_asked_and_grow_by_the_ratio_at_most() -> None:
    x = edges(-0.5, 0.5, (-0.1, 0.1), 2e-3, 1.04)
    sizes = np.diff(x)
    inside = (x[1:] < 0.1001) & (x[:-1] > -0.1001)
    assert sizes[inside] == pytest.approx(2e-3)
    growth = sizes[1:] / sizes[:-1]
    assert growth.max() <= 1.0401
    assert growth.min() >= 1.0 / 1.0401


def test_a_grid_knows_its_centres_sizes_and_smallest_cell() -> None:
    grid = Grid(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.5, 1.0, 1.5]))
    assert (grid.nx, grid.ny, grid.cells, grid.h) == (2, 3, 6, 0.5)
    assert grid.xc == pytest.approx([0.5, 2.0])
    assert grid.dy == pytest.approx(0.5)


@pytest.mark.parametrize("ratio", [1.0, 1.001, 1.04, 1.2])
def test_no_cell_outside_is_smaller_than_those_around_the_body(ratio: float) -> None:
    for outside in np.arange(1.0, 15.01, 0.1):
        sizes = np.diff(edges(0.0, 2.0 + outside, (0.0, 2.0), 1.0, ratio))
        assert sizes.sum() == pytest.approx(2.0 + outside)
        assert sizes.min() >= 1.0 / MAX_SIZE_RATIO
        if len(sizes) - 2 < int(outside + 1e-9):  # with one more they would not be smaller
            assert (sizes[1:] / sizes[:-1]).max() <= ratio + 1e-9
