"""Bodies in the water: conservation of momentum, light bodies, and bending without locking."""

import gc
import threading

import numpy as np
import pytest
from numpy.typing import DTypeLike
from rigs.processes import wait_until

from fishd.virtual.swimmer import threads
from fishd.virtual.swimmer.beam import Beam
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.immersed import Immersed, LeftTheGrid

CELL, LENGTH, HALF = 2e-3, 0.06, 6e-3
EI = 2e-3


def swimmer(
    *,
    cell: float = CELL,
    excess: float = 0.0,
    clamped: bool = False,
    stream: float = 0.0,
    dtype: DTypeLike = np.float32,
) -> Immersed:
    """Return a bar in a small tank, with its head at (0.1, 0.06)."""
    grid = Grid(edges(0.0, 0.3, (0.07, 0.2), cell, 1.1), edges(0.0, 0.12, (0.02, 0.1), cell, 1.1))
    flow = Flow(grid, 1e-6, "slip", inlet=np.full(grid.ny, stream), dtype=dtype)
    flow.u[:] = stream
    beam = Beam(
        LENGTH,
        lambda X: np.full_like(X, HALF),
        lambda X: np.full_like(X, EI),
        10,
        0.5 * cell,
        density=excess,
        clamped=clamped,
    )
    beam.q[:2] = 0.1, 0.06
    return Immersed(flow, 1000.0, beam)


def bend(body: Immersed, curvature: float) -> Array:
    return body.beam.drive(lambda X: np.full_like(X, curvature))


def momentum(body: Immersed) -> float:
    """Return the momentum along x of the water and of the body's excess mass [kg m/s per metre]."""
    excess = float(body.beam.excess[:, 0] @ body.velocity[:, 0])
    return body.density * body.flow.momentum() + excess


@pytest.mark.parametrize("excess", [0.0, 3000.0])
@pytest.mark.parametrize(("dtype", "relative"), [(np.float64, 1e-12), (np.float32, 1e-6)])
def test_water_and_body_together_keep_their_momentum(
    excess: float, dtype: DTypeLike, relative: float
) -> None:
    body = swimmer(excess=excess, dtype=dtype)
    forces = bend(body, 6.0)
    forces[0] = 2.0  # an external force
    gained = 0.0
    for _ in range(20):
        body.step(2e-3, forces)
        gained += body.density * body.flow.boundary_impulse + 2e-3 * 2.0
        largest = max(2e-3 * 2.0, float(np.abs(body.force).sum()) * 2e-3)
        assert momentum(body) == pytest.approx(gained, abs=relative * largest)


@pytest.mark.parametrize(("angle", "lowest"), [(0.0, 1.0), (0.3, 0.8), (0.25 * np.pi, 1.0)])
@pytest.mark.parametrize("half_cells", [0.05, 0.5])
def test_a_plate_thinner_than_a_cell_lets_little_water_through(
    half_cells: float, angle: float, lowest: float
) -> None:
    """The added mass of a plate across itself is ρπ(L/2)²; with its own thickness it had 0.20."""
    cell = 1e-3
    positions = edges(-0.4, 0.4, (-0.05, 0.05), cell, 1.1)
    flow = Flow(Grid(positions, positions), 1e-6, "slip")
    beam = Beam(LENGTH, lambda X: np.full_like(X, half_cells * cell), np.ones_like, 10, 0.5 * cell)
    beam.q[:2] = -0.5 * LENGTH * np.cos(angle), -0.5 * LENGTH * np.sin(angle)
    beam.q[2:] = angle
    body = Immersed(flow, 1000.0, beam)
    across = np.array([-np.sin(angle), np.cos(angle)])
    jacobian = beam.motion(np.full(beam.slices, angle))[:, :2]
    force = np.einsum("s,skq,k->q", beam.share, jacobian, across)
    for _ in range(100):
        body.step(1e-3, force)
    velocity = float(beam.share @ body.velocity[:, :2] @ across)
    added = 0.1 / velocity / (1000.0 * np.pi * (0.5 * LENGTH) ** 2)
    assert lowest < added < 1.1


def compute_bend(steps: int) -> float:
    """Return the bend after 0.1 s [rad]."""
    body = swimmer()
    forces = bend(body, 10.0)
    for _ in range(steps):
        body.step(0.1 / steps, forces)
    return float(body.beam.q[-1] - body.beam.q[2])


def test_it_bends_as_far_however_short_the_steps() -> None:
    assert compute_bend(25) > 0.2
    assert compute_bend(400) == pytest.approx(compute_bend(50), rel=0.05)


@pytest.mark.parametrize("excess", [-200.0, 0.0, 7000.0])
def test_a_light_body_is_as_stable_as_a_heavy_one(excess: float) -> None:
    body = swimmer(excess=excess)
    forces = bend(body, 8.0)
    fastest = 0.0
    for k in range(300):
        body.step(2e-3, forces if k < 50 else 0.0 * forces)
        fastest = max(fastest, float(np.abs(body.velocity[:, :2]).max()))
    assert 0.01 < fastest < 0.5
    assert np.abs(body.velocity[:, :2]).max() < 0.6 * fastest


def test_a_loose_body_drifts_with_the_stream() -> None:
    body = swimmer(stream=0.1)
    body.beam.rate[0] = 0.1
    body.flow.grid_velocity[0] = 0.1
    body.flow.inlet[:] = 0.1
    for _ in range(50):
        body.step(4e-3)
    assert body.velocity[:, 0] == pytest.approx(0.1, rel=0.02)


def test_a_clamped_root_stays_where_it_is() -> None:
    body = swimmer(clamped=True, stream=0.1)
    forces = bend(body, 5.0)
    for _ in range(20):
        body.step(4e-3, forces)
    assert body.beam.q[:3] == pytest.approx([0.1, 0.06, 0.0])
    assert body.beam.q[-1] != 0.0


def circle_in_stream(steps: int) -> tuple[Immersed, float]:
    """Return the flow after 0.6 s, and the drag [N/m]."""
    grid = Grid(np.linspace(0.0, 0.3, 61), np.linspace(0.0, 0.2, 41))
    flow = Flow(grid, 1e-4, "slip", inlet=np.full(grid.ny, 0.1))
    flow.u[:] = 0.1
    body = Immersed(flow, 1000.0)
    body.add_circle(0.1, 0.1, 0.03)
    for _ in range(steps):
        body.step(0.6 / steps)
    return body, float(body.fixed_impulse[0]) * steps / 0.6


def test_water_rests_in_a_circle_and_pushes_it_downstream() -> None:
    body, drag = circle_in_stream(60)
    assert abs(body.flow.u[20, 20]) < 2e-3
    assert 0.5 < drag / (0.5 * 1000.0 * 0.1**2 * 0.06) < 5.0
    assert abs(body.fixed_impulse[1]) < 0.01 * abs(body.fixed_impulse[0])


def test_the_drag_of_a_circle_does_not_depend_on_the_step() -> None:
    """ν Δt/h² is 2.4 / steps; around a fish, it is 0.0005 to 0.003. Long steps move the wall in."""
    reference = circle_in_stream(3840)[1]
    for steps, relative in ((60, 0.05), (240, 0.01), (960, 0.003), (1920, 0.002)):
        assert circle_in_stream(steps)[1] == pytest.approx(reference, rel=relative)


@pytest.mark.parametrize(
    ("place", "message"),
    [((0.15, 0.06), "small cells"), ((0.26, 0.06), "left the water"), ((0.1, 0.119), "left the")],
)
def test_a_body_that_leaves_is_told(place: tuple[float, float], message: str) -> None:
    body = swimmer()
    body.beam.q[:2] = place
    with pytest.raises(LeftTheGrid, match=message):
        body.step(1e-3)


def test_a_cylinder_that_starts_at_once_has_the_published_drag() -> None:
    """Koumoutsakos and Leonard, J. Fluid Mech. 296, 1995: Re 550, at Ut/R = 0.794 and 2.893."""
    h = 1.0 / 40
    grid = Grid(edges(-8.0, 8.0, (-0.8, 1.2), h, 1.08), edges(-8.0, 8.0, (-0.7, 0.7), h, 1.08))
    flow = Flow(grid, 1.0 / 550.0, "slip", inlet=np.ones(grid.ny))
    flow.u[:] = 1.0
    body = Immersed(flow, 1.0)
    body.add_circle(0.0, 0.0, 0.5)
    dt = 0.15 * h
    drag = []
    for _ in range(round(1.5 / dt)):
        body.step(dt)
        drag.append(2.0 * float(body.fixed_impulse[0]) / dt)
    times = 2.0 * dt * (np.arange(len(drag)) + 0.5)
    assert np.interp([0.794, 2.893], times, drag) == pytest.approx([0.703, 1.287], rel=0.05)


def test_a_second_thread_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    def swim(cells: int) -> Immersed:
        monkeypatch.setattr(threads, "MIN_CELLS", cells)
        monkeypatch.setattr(threads.config, "NUMBA_NUM_THREADS", 2)
        body = swimmer()
        body.add_circle(0.08, 0.06, 0.005)
        for _ in range(20):
            body.step(2e-3, bend(body, 5.0))
        return body

    before = threading.enumerate()
    alone, together = swim(10**9), swim(1)
    new = [thread for thread in threading.enumerate() if thread not in before]
    (worker,) = (thread for thread in new if thread.name.startswith("fishd-swimmer"))
    for name, values in alone.state().items():
        assert np.array_equal(together.state()[name], values), name
    del together
    gc.collect()
    wait_until(lambda: not worker.is_alive())
