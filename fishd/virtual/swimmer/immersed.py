"""Bodies in the flow, which impose their motion on the water and conserve momentum.

The method is direct forcing on a fixed grid (Fadlun et al., J. Comput. Phys. 161, 2000,
doi:10.1006/jcph.2000.6484), with the fraction of the cell around a face that the body covers
(Kajishima and Takiguchi, Int. J. Heat Fluid Flow 23, 2002, doi:10.1016/S0142-727X(02)00159-5), and
a moment term (see `covers`). Inside the body, the water of the grid represents its mass: the
momentum there, projected on the motions of the beam, gives the motion of the beam. No forces are
exchanged between two solvers, so that light bodies are as stable as heavy ones.
"""

import numpy as np

from fishd.core.errors import FishdError
from fishd.virtual.swimmer.beam import Beam
from fishd.virtual.swimmer.covers import (
    Covered,
    Painter,
    add_chi,
    circle,
    gather,
    impose,
    uncover,
    weigh_cells,
)
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import MAX_SIZE_RATIO, Array, Field

IMPLICIT_FRACTION = 0.55
"""Fraction of the new shape in the elastic forces of a step; with 0.5, the shortest waves of the
beam would not decay."""
_DIAGONAL = np.arange(3)


class LeftTheGrid(FishdError):
    """The body has reached the coarse cells of the grid."""


class Immersed:
    """Beam, rigid circle, or both, in a flow."""

    def __init__(self, flow: Flow, density: float, beam: Beam | None = None) -> None:
        """density: density of the water [kg/m³]"""
        self.flow, self.density, self.beam = flow, density, beam
        grid = flow.grid
        self._painters = Painter(0, grid.x, grid.yc, grid.h), Painter(1, grid.xc, grid.y, grid.h)
        self._positions = grid.yc, grid.xc
        """Positions of the faces of u and v that the rotation of a body depends on [m]."""
        self._fixed: tuple[Covered, Covered] | None = None
        self._fixed_chi = np.zeros_like(flow.u), np.zeros_like(flow.v)
        self._chi = np.zeros_like(flow.u), np.zeros_like(flow.v)
        self._weight, self._fixed_weight = np.ones_like(flow.p), np.ones_like(flow.p)
        """Fraction of its divergence that each cell loses, with all bodies and with the circle."""
        self._covered: tuple[Covered, Covered] | None = None
        """Coverage by the beam in the latest step."""
        self._cell_mass = density * grid.h**2
        self.fixed_impulse = np.zeros(2)
        """Impulse that the circle took from the water in the latest step [N s]."""
        if beam:
            self.velocity = np.zeros((beam.slices, 3))
            """vx, vy [m/s] and θ̇ [rad/s] of the slices at the latest step."""
            self.force = np.zeros((beam.slices, 3))
            """Force and torque of the slices on the water inside them, for a body one metre deep,
            over the latest step [N, N m]."""
            self.mass = np.zeros((beam.slices, 3, 3))
            """Mass matrices of the water inside each slice."""
            self._before = np.zeros(beam.size)

    def add_circle(self, x: float, y: float, radius: float) -> None:
        """Add a rigid circle in the fine part of the grid; lengths in m."""
        grid = self.flow.grid
        on_u = circle(grid.x - x, grid.yc - y, radius, grid.h)
        on_v = circle(grid.xc - x, grid.y - y, radius, grid.h)
        self._fixed = on_u, on_v
        self._cover(self._fixed)
        for fixed, chi in zip(self._fixed_chi, self._chi, strict=True):
            fixed[:] = chi
        self._fixed_weight[:] = self._weight

    def step(self, dt: float, forces: Array | None = None) -> None:
        """Advance by `dt` [s]; forces: those on the beam's unknowns in the middle of the step."""
        self.flow.predict(dt)
        if self._fixed:
            self._hold(self._fixed)
        if self.beam:
            self._move(self.beam, dt, forces)
        self.flow.project(dt, self._weight)

    def _hold(self, fixed: tuple[Covered, Covered]) -> None:
        """Bring the water inside the circle to rest."""
        changes = self._impose(fixed, np.zeros((1, 3)), np.zeros((1, 2)))
        self.fixed_impulse = -self._cell_mass * np.array(changes)

    def _impose(
        self, covered: tuple[Covered, Covered], motion: Array, places: Array
    ) -> tuple[float, float]:
        """Impose the motion of a body; return the sums of the changes of u and v [m/s]."""
        flow, h = self.flow, self.flow.grid.h
        on_u, on_v = covered
        at_u, at_v = self._positions
        return flow.pairs.run(
            lambda: impose(0, on_u, flow.predicted_u, motion, places, at_u, h),
            lambda: impose(1, on_v, flow.predicted_v, motion, places, at_v, h),
        )

    def _cover(self, covered: tuple[Covered, Covered]) -> None:
        """Add a body to χ of these faces, and weigh the divergence of the cells beside them."""
        (on_u, on_v), (chi_u, chi_v), weight = covered, self._chi, self._weight
        run = self.flow.pairs.run
        run(lambda: add_chi(on_u, chi_u), lambda: add_chi(on_v, chi_v))
        run(
            lambda: weigh_cells(0, on_u, chi_u, chi_v, weight),
            lambda: weigh_cells(1, on_v, chi_u, chi_v, weight),
        )

    def _uncover(self, covered: tuple[Covered, Covered]) -> None:
        """Remove the beam from χ of these faces and the weights of the cells beside them."""
        weights = self._weight, self._fixed_weight
        (on_u, on_v), (chi_u, chi_v), (fixed_u, fixed_v) = covered, self._chi, self._fixed_chi
        self.flow.pairs.run(
            lambda: uncover(0, on_u, chi_u, fixed_u, *weights),
            lambda: uncover(1, on_v, chi_v, fixed_v, *weights),
        )

    def _move(self, beam: Beam, dt: float, forces: Array | None) -> None:
        """Compute the new motion of the beam, and impose it on the water inside the beam."""
        flow, h = self.flow, self.flow.grid.h
        travel = np.zeros(beam.size)
        travel[:2] = flow.grid_velocity
        places, angle = beam.shape(beam.q + dt * (1.5 * beam.rate - 0.5 * self._before - travel))
        self._check_place(places, float(beam.half_thickness.max()))
        body = places, angle, beam.half_thickness, beam.taper, beam.spacing, beam.clamped
        paint_u, paint_v = (painter.paint for painter in self._painters)
        on_u, on_v = flow.pairs.run(lambda: paint_u(*body), lambda: paint_v(*body))
        if self._fixed:
            _exclude_fixed(on_u, self._fixed_chi[0])
            _exclude_fixed(on_v, self._fixed_chi[1])
        self.mass, momentum = np.zeros_like(self.mass), np.zeros_like(self.velocity)
        for k, covered, predicted in ((0, on_u, flow.predicted_u), (1, on_v, flow.predicted_v)):
            water = predicted, places, self._positions[k], self._cell_mass, h
            gather(k, covered, *water, self.mass, momentum)
        jacobian = beam.motion(angle)
        rate = self._solve(beam, dt, jacobian, momentum, forces)
        self.velocity = jacobian @ rate
        self.force = ((self.mass @ self.velocity[:, :, None])[:, :, 0] - momentum) / dt
        self._impose((on_u, on_v), self.velocity, places)
        beam.q = beam.q + dt * (0.5 * (rate + beam.rate) - travel)
        self._before, beam.rate = beam.rate, rate
        if self._covered:
            self._uncover(self._covered)
        self._covered = on_u, on_v
        self._cover(self._covered)

    def _solve(
        self, beam: Beam, dt: float, jacobian: Array, momentum: Array, forces: Array | None
    ) -> Array:
        """Return the rates of the unknowns at the end of the step, from the total momentum."""
        flat = jacobian.reshape(-1, beam.size)
        total_mass = self.mass.copy()
        total_mass[:, _DIAGONAL, _DIAGONAL] += beam.excess
        M = flat.T @ (total_mass @ jacobian).reshape(-1, beam.size)
        momenta = flat.T @ (momentum + beam.excess * self.velocity).ravel()
        reach = 0.5 * IMPLICIT_FRACTION * dt
        momenta -= dt * (beam.K @ (beam.q + reach * beam.rate))
        if forces is not None:
            momenta += dt * forces
        system = M + dt * (reach * beam.K + beam.D)
        rate = np.zeros(beam.size)
        first = beam.free[0]
        rate[first:] = np.linalg.solve(system[first:, first:], momenta[first:])
        return rate

    def _check_place(self, places: Array, half_thickness: float) -> None:
        """Raise `LeftTheGrid` where the cells around the body are coarse."""
        grid = self.flow.grid
        for axis, edges, sizes in ((0, grid.x, grid.dx), (1, grid.y, grid.dy)):
            low = places[:, axis].min() - half_thickness - 2.0 * grid.h
            high = places[:, axis].max() + half_thickness + 2.0 * grid.h
            if not (edges[1] < low and high < edges[-2]):
                raise LeftTheGrid("the body left the water")
            first, last = np.searchsorted(edges, [low, high])
            if sizes[int(first) - 1 : int(last)].max() > MAX_SIZE_RATIO * grid.h:
                raise LeftTheGrid("the body left the part of the grid with small cells")

    def state(self) -> dict[str, Array]:
        """Return the complete state by name."""
        state = self.flow.state()
        if self.beam:
            state |= {
                "q": self.beam.q.copy(),
                "rate": self.beam.rate.copy(),
                "rate_before": self._before.copy(),
                "velocity": self.velocity.copy(),
            }
        return state

    def restore(self, state: dict[str, Array]) -> None:
        """Restore a result of `state`."""
        self.flow.restore(state)
        if self.beam:
            self.beam.q, self.beam.rate = state["q"].copy(), state["rate"].copy()
            self._before, self.velocity = state["rate_before"].copy(), state["velocity"].copy()


def _exclude_fixed(covered: Covered, fixed_chi: Field) -> None:
    """Remove from the coverage of the beam the part that a fixed body covers."""
    fixed = fixed_chi[covered.i, covered.j]
    np.minimum(covered.chi, 1.0 - fixed, out=covered.chi)
    for moment in (covered.mu1_x, covered.mu1_y):
        np.multiply(moment, fixed == 0.0, out=moment)
