"""Bodies in the flow, which impose their motion on the water and conserve momentum.

The method is direct forcing on a fixed grid (Fadlun et al., J. Comput. Phys. 161, 2000,
doi:10.1006/jcph.2000.6484), with the fraction of the cell around a face that the body covers
(Kajishima and Takiguchi, Int. J. Heat Fluid Flow 23, 2002, doi:10.1016/S0142-727X(02)00159-5), of
second order (see `covers`). Inside the body, the water of the grid represents its mass: the
momentum there, projected on the motions of the beam, gives the motion of the beam. No forces are
exchanged between two solvers, so that light bodies are as stable as heavy ones.
"""

import numpy as np

from fishd.core.errors import FishdError
from fishd.virtual.swimmer.beam import Beam
from fishd.virtual.swimmer.covers import Covered, circle, gather, impose, paint, slip
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import MAX_SIZE_RATIO, Array

IMPLICIT = 0.55
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
        self._fixed: tuple[Covered, Covered] | None = None
        self._fixed_weight = np.ones((grid.nx, grid.ny))
        self._divergence_weight = self._fixed_weight.copy()
        self._last_box = slice(0, 0), slice(0, 0)
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
        on_u = circle(grid.x[:, None] - x, grid.yc[None] - y, radius, grid.h)
        on_v = circle(grid.xc[:, None] - x, grid.y[None] - y, radius, grid.h)
        self._fixed = on_u, on_v
        self._fixed_weight = _divergence_weight(on_u.share, on_v.share)
        self._divergence_weight = self._fixed_weight.copy()

    def step(self, dt: float, forces: Array | None = None) -> None:
        """Advance by `dt` [s]; forces: those on the beam's unknowns in the middle of the step."""
        self.flow.predict(dt)
        if self._fixed:
            self._hold(*self._fixed)
        if self.beam:
            self._move(self.beam, dt, forces)
        self.flow.project(dt, self._divergence_weight)

    def _hold(self, on_u: Covered, on_v: Covered) -> None:
        """Bring the water inside the circle to rest."""
        flow = self.flow
        removed_u = on_u.share * flow.ahead_u - slip(flow.ahead_u, on_u)
        removed_v = on_v.share * flow.ahead_v - slip(flow.ahead_v, on_v)
        self.fixed_impulse = self._cell_mass * np.array([removed_u.sum(), removed_v.sum()])
        flow.ahead_u -= removed_u
        flow.ahead_v -= removed_v

    def _move(self, beam: Beam, dt: float, forces: Array | None) -> None:
        """Compute the new motion of the beam, and impose it on the water inside the beam."""
        flow, grid, h = self.flow, self.flow.grid, self.flow.grid.h
        travel = np.zeros(beam.size)
        travel[0] = flow.grid_velocity
        places, angle = beam.shape(beam.q + dt * (1.5 * beam.rate - 0.5 * self._before - travel))
        i, j = self._box(places, float(beam.half_thickness.max()))
        faces_u = slice(i.start, i.stop + 1), j
        faces_v = i, slice(j.start, j.stop + 1)
        body = places, angle, beam.half_thickness, beam.taper, beam.spacing, h
        on_u = paint(*body, grid.x[faces_u[0]], grid.yc[j], beam.clamped)
        on_v = paint(*body, grid.xc[i], grid.y[faces_v[1]], beam.clamped)
        if self._fixed:
            _exclude_fixed(on_u, self._fixed[0], faces_u)
            _exclude_fixed(on_v, self._fixed[1], faces_v)
        around_u = _copy_with_margin(flow.ahead_u, faces_u)
        around_v = _copy_with_margin(flow.ahead_v, faces_v)
        self.mass, momentum = gather(
            places,
            (on_u, around_u, grid.x[faces_u[0]], grid.yc[j]),
            (on_v, around_v, grid.xc[i], grid.y[faces_v[1]]),
            self._cell_mass,
            h,
        )
        moves = beam.motion(angle)
        rate = self._solve(beam, dt, moves, momentum, forces)
        self.velocity = moves @ rate
        self.force = ((self.mass @ self.velocity[:, :, None])[:, :, 0] - momentum) / dt
        moving = self.velocity, places
        impose(*moving, on_u, around_u, flow.ahead_u[faces_u], grid.yc[j], h, True)
        impose(*moving, on_v, around_v, flow.ahead_v[faces_v], grid.xc[i], h, False)
        beam.q = beam.q + dt * (0.5 * (rate + beam.rate) - travel)
        self._before, beam.rate = beam.rate, rate
        share_u, share_v = on_u.share, on_v.share
        if self._fixed:
            share_u = share_u + self._fixed[0].share[faces_u]
            share_v = share_v + self._fixed[1].share[faces_v]
        self._divergence_weight[self._last_box] = self._fixed_weight[self._last_box]
        self._divergence_weight[i, j] = _divergence_weight(share_u, share_v)
        self._last_box = i, j

    def _solve(
        self, beam: Beam, dt: float, moves: Array, momentum: Array, forces: Array | None
    ) -> Array:
        """Return the rates of the unknowns at the end of the step, from the total momentum."""
        flat = moves.reshape(-1, beam.size)
        total_mass = self.mass.copy()
        total_mass[:, _DIAGONAL, _DIAGONAL] += beam.excess
        M = flat.T @ (total_mass @ moves).reshape(-1, beam.size)
        momenta = flat.T @ (momentum + beam.excess * self.velocity).ravel()
        reach = 0.5 * IMPLICIT * dt
        momenta -= dt * (beam.K @ (beam.q + reach * beam.rate))
        if forces is not None:
            momenta += dt * forces
        system = M + dt * (reach * beam.K + beam.D)
        rate = np.zeros(beam.size)
        first = beam.free[0]
        rate[first:] = np.linalg.solve(system[first:, first:], momenta[first:])
        return rate

    def _box(self, places: Array, half_thickness: float) -> tuple[slice, slice]:
        """Return the cells around the body; raises `LeftTheGrid` where some are coarse."""
        grid = self.flow.grid
        ranges = []
        for axis, edges, all_sizes in ((0, grid.x, grid.dx), (1, grid.y, grid.dy)):
            low = places[:, axis].min() - half_thickness - 2.0 * grid.h
            high = places[:, axis].max() + half_thickness + 2.0 * grid.h
            if not (edges[1] < low and high < edges[-2]):
                raise LeftTheGrid("the body left the water")
            first, last = np.searchsorted(edges, [low, high])
            ranges.append(slice(int(first) - 1, int(last)))
            if all_sizes[ranges[-1]].max() > MAX_SIZE_RATIO * grid.h:
                raise LeftTheGrid("the body left the part of the grid with small cells")
        return ranges[0], ranges[1]

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


def _copy_with_margin(values: Array, faces: tuple[slice, slice]) -> Array:
    """Return a copy of these faces with one more on every side."""
    i, j = faces
    return values[i.start - 1 : i.stop + 1, j.start - 1 : j.stop + 1].copy()


def _exclude_fixed(covered: Covered, fixed: Covered, faces: tuple[slice, slice]) -> None:
    """Remove from the coverage of the beam the part that a fixed body covers."""
    np.minimum(covered.share, 1.0 - fixed.share[faces], out=covered.share)
    is_free = fixed.share[faces] == 0.0
    np.multiply(covered.moment_x, is_free, out=covered.moment_x)
    np.multiply(covered.moment_y, is_free, out=covered.moment_y)


def _divergence_weight(cover_u: Array, cover_v: Array) -> Array:
    """Return weights of the divergence: 0 in cells inside a body.

    A bent body is longer on one side and shorter on the other. If its inner cells were free of
    divergence, short steps would prevent it from bending.
    """
    return np.asarray(1.0 - cover_u[1:] * cover_u[:-1] * cover_v[:, 1:] * cover_v[:, :-1])
