"""Water alone: conservation of volume and momentum, and decay of vortices."""

from typing import Literal

import numpy as np
import pytest
from numpy.typing import DTypeLike

from fishd.virtual.swimmer.flow import Flow, face_flux, flux_weights
from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.settings import DISSIPATION

NU = 1e-3


def box(cells: int, stretched: bool = False) -> Grid:
    """Return the flow in a square of 1 m."""
    if stretched:
        x = edges(0.0, 1.0, (0.3, 0.7), 1.0 / cells, 1.08)
        return Grid(x, x.copy())
    x = np.linspace(0.0, 1.0, cells + 1)
    return Grid(x, x.copy())


def divergence(flow: Flow) -> Array:
    grid = flow.grid
    return np.diff(flow.u, axis=0) / grid.dx[:, None] + np.diff(flow.v, axis=1) / grid.dy


def put_vortex(flow: Flow, x: float, y: float, age: float, stream: float = 0.0) -> None:
    """Add a Taylor vortex (1918), an exact solution: u_θ ~ r/t² exp(−r²/4νt), up to 0.3 m/s."""
    grid = flow.grid
    core = 4.0 * NU * age
    strength = 0.3 * np.sqrt(2.0 * np.e / core)
    for values, px, py, swirl in (
        (flow.u, grid.x[:, None], grid.yc[None] + 0.0 * grid.x[:, None], -1.0),
        (flow.v, grid.xc[:, None], grid.y[None] + 0.0 * grid.xc[:, None], 1.0),
    ):
        rx, ry = px - x, py - y
        arm = ry if swirl < 0.0 else rx
        values[:] = swirl * strength * arm * np.exp(-(rx**2 + ry**2) / core)
    flow.u[:] += stream
    flow.inlet = np.full(grid.ny, stream)
    flow.v[:, [0, -1]] = 0.0


def run(flow: Flow, seconds: float, dt: float) -> None:
    for _ in range(round(seconds / dt)):
        flow.predict(dt)
        flow.project(dt)


def test_after_a_step_the_water_keeps_its_volume() -> None:
    flow = Flow(box(24, stretched=True), NU, "no-slip", dtype=np.float64)
    flow.predict(0.01)
    random = np.random.default_rng(1)
    flow.predicted_u[1:-1] = random.normal(size=flow.u[1:-1].shape)
    flow.predicted_v[:, 1:-1] = random.normal(size=flow.v[:, 1:-1].shape)
    flow.project(0.01)
    assert divergence(flow) == pytest.approx(0.0, abs=1e-9)


def test_a_vortex_ages_at_the_right_rate() -> None:
    flow = Flow(box(64), NU, "slip")
    put_vortex(flow, 0.5, 0.5, age=2.5)
    before = flow.vorticity().max()
    run(flow, 1.25, 0.0125)
    assert flow.vorticity().max() / before == pytest.approx((2.5 / 3.75) ** 2, rel=0.02)


def measure_advection_error(cells: int) -> float:
    """Return the relative error of a vortex after advection by a stream."""
    dt = 0.2 / cells
    flow, right = Flow(box(cells), NU, "slip"), Flow(box(cells), NU, "slip")
    put_vortex(flow, 0.4, 0.5, age=1.5, stream=0.25)
    run(flow, 0.8, dt)
    put_vortex(right, 0.6, 0.5, age=2.3, stream=0.25)
    right.u[:] = 0.25 + (right.u - 0.25) * (1.5 / 2.3) ** 1.5
    return float(np.abs(flow.u - right.u).max())


def test_what_a_stream_carries_along_gets_there_with_an_error_between_third_and_second_order() -> (
    None
):
    """The fluxes have the fourth order and the third; the velocity that carries has the second."""
    errors = [measure_advection_error(cells) for cells in (32, 48, 64, 96)]
    # With the whole upwind dissipation: 16.6, 5.9, 2.4, 0.60 · 10⁻³.
    assert np.all(np.array(errors) < [9e-3, 3e-3, 1.35e-3, 5.4e-4])
    assert errors[0] / errors[2] > 6.0
    assert errors[1] / errors[3] > 5.0


def test_a_grid_that_travels_with_the_stream_sees_the_same_water() -> None:
    still, travelling = Flow(box(48), NU, "slip"), Flow(box(48), NU, "slip")
    put_vortex(still, 0.5, 0.5, age=2.0)
    put_vortex(travelling, 0.5, 0.5, age=2.0, stream=-0.3)
    travelling.grid_velocity[0] = -0.3
    for flow in (still, travelling):
        run(flow, 0.5, 0.005)
    middle = slice(12, 36)
    assert travelling.u[middle, middle] + 0.3 == pytest.approx(still.u[middle, middle], abs=2e-3)


@pytest.mark.parametrize(("walls", "across"), [("slip", 0.02), ("no-slip", 0.0)])
@pytest.mark.parametrize(("dtype", "relative"), [(np.float64, 1e-14), (np.float32, 1e-6)])
def test_its_momentum_changes_by_what_crosses_the_boundaries(
    dtype: DTypeLike, relative: float, walls: Literal["slip", "no-slip"], across: float
) -> None:
    flow = Flow(box(32, stretched=True), NU, walls, dtype=dtype)
    put_vortex(flow, 0.6, 0.45, age=8.0, stream=0.1)
    flow.grid_velocity[:] = -0.05, across
    start, crossed = flow.momentum(), 0.0
    for _ in range(8):
        run(flow, 0.01, 0.01)
        crossed += flow.boundary_impulse
        assert flow.momentum() - start == pytest.approx(crossed, abs=relative * abs(start))
    assert abs(crossed) > 1e-5


def test_water_at_rest_passes_the_walls_of_a_grid_that_travels_across() -> None:
    still, travelling = Flow(box(64), NU, "slip"), Flow(box(64), NU, "slip")
    put_vortex(still, 0.5, 0.5, age=2.0)
    put_vortex(travelling, 0.5, 0.6, age=2.0)
    travelling.grid_velocity[1] = 0.2
    for flow in (still, travelling):
        run(flow, 0.5, 0.005)  # 0.1 m
    middle = slice(16, 48)
    assert travelling.u[middle, middle] == pytest.approx(still.u[middle, middle], abs=2e-3)


def test_a_cubic_passes_a_face_exactly_and_without_dissipation_up_to_its_third_difference() -> None:
    weights = flux_weights.py_func(float)
    primitive = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.5, 0.7])  # of a cubic
    cells = [float(primitive(k + 1) - primitive(k)) for k in (-2, -1, 0, 1)]  # its means
    cubic = primitive.deriv()
    central = 0.5 * (face_flux(1.0, *cells, weights) - face_flux(-1.0, *cells, weights))
    assert central == pytest.approx(float(cubic(0.0)))
    dissipation = face_flux(1.0, *cells, weights) - central
    assert dissipation == pytest.approx(DISSIPATION / 12.0 * float(cubic.deriv(3)(0.0)))


def test_it_says_how_far_the_water_goes_in_a_step() -> None:
    flow = Flow(box(10), NU, "slip")
    flow.u[4, 4], flow.grid_velocity[0] = 0.2, -0.1
    assert flow.courant_number(0.1) == pytest.approx(0.3)
    flow.v[2, 2] = np.nan
    assert np.isnan(flow.courant_number(0.1))
