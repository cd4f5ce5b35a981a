"""Bodies in the flow: which faces of the grid they cover, and momentum passed on without loss.

Direct forcing on a fixed grid (Fadlun et al., J. Comput. Phys. 161, 2000,
doi:10.1006/jcph.2000.6484) by the share of a face that the body covers (Kajishima and Takiguchi,
Int. J. Heat Fluid Flow 23, 2002, doi:10.1016/S0142-727X(02)00159-5). Where the body is, the water
of the grid is its mass: the momentum that it has there, projected on the motions that the beam
can make, gives the motion of the beam. So no force is exchanged between two solvers, and light
bodies are no harder than heavy ones.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from fishd.core.errors import FishdError
from fishd.swimmer.beam import Beam
from fishd.swimmer.flow import Flow
from fishd.swimmer.grid import Array

SHIFT = 0.5
"""A face is half covered this many cells inside of the surface: the water next to a body moves with
it, and makes it thicker by about so much."""
IMPLICIT = 0.55
"""Share of the new shape in the elastic forces of a step; 0.5 would let the shortest waves of the
beam ring for ever."""


class LeftTheGrid(FishdError):
    """The body is where cells are coarse."""


class Immersed:
    """A beam in a flow, rigid circles, or both."""

    def __init__(self, flow: Flow, density: float, beam: Beam | None = None) -> None:
        """density: of the water [kg/m³]"""
        self.flow, self.density, self.beam = flow, density, beam
        grid = flow.grid
        self._fixed_u, self._fixed_v = np.zeros(flow.u.shape), np.zeros(flow.v.shape)
        self._freedom = np.ones((grid.nx, grid.ny))
        self._has_fixed = False
        self.fixed_impulse = np.zeros(2)
        """What the circles took from the water in the latest step [N s]."""
        if beam:
            self.velocity = np.zeros((beam.slices, 3))
            """Of the slices: vx, vy [m/s] and θ̇ [rad/s], at the latest step."""
            self.force = np.zeros((beam.slices, 3))
            """Of the slices on the water where they are: force and torque [N, N m], over the
            latest step."""
            self.mass = np.zeros((beam.slices, 3, 3))
            """Of the water where each slice is."""
            self._before = np.zeros(beam.size)

    def add_circle(self, x: float, y: float, radius: float) -> None:
        """Put a rigid circle there; lengths in m."""
        grid = self.flow.grid
        for cover, px, py in (
            (self._fixed_u, grid.x[:, None], grid.yc[None]),
            (self._fixed_v, grid.xc[:, None], grid.y[None]),
        ):
            distance = np.hypot(px - x, py - y) - radius
            np.maximum(cover, np.clip(0.5 - distance / grid.h - SHIFT, 0.0, 1.0), out=cover)
        self._freedom = _freedom(self._fixed_u, self._fixed_v)
        self._has_fixed = True

    def step(self, dt: float, forces: Array | None = None) -> None:
        """One step of `dt` [s]; forces: on the unknowns of the beam, at the middle of the step."""
        self.flow.predict(dt)
        if self._has_fixed:
            self._hold_fixed()
        freedom = self._freedom
        if self.beam:
            freedom = self._move_beam(self.beam, dt, forces)
        self.flow.project(dt, freedom)

    def _hold_fixed(self) -> None:
        """Bring the water to rest where the circles are."""
        flow, grid = self.flow, self.flow.grid
        taken_u, taken_v = self._fixed_u * flow.ahead_u, self._fixed_v * flow.ahead_v
        across_x = np.gradient(grid.x)  # between centres: widths of the faces' own cells
        across_y = np.gradient(grid.y)
        self.fixed_impulse = self.density * np.array(
            [across_x @ (taken_u @ grid.dy), grid.dx @ (taken_v @ across_y)]
        )
        flow.ahead_u -= taken_u
        flow.ahead_v -= taken_v

    def _move_beam(self, beam: Beam, dt: float, forces: Array | None) -> Array:
        """Find the new motion, and let the water where the beam is have it; returns the freedom."""
        flow, grid = self.flow, self.flow.grid
        travel = np.zeros(beam.size)
        travel[0] = flow.grid_velocity
        ahead = beam.q + dt * (1.5 * beam.rate - 0.5 * self._before - travel)
        places, angle = beam.shape(ahead)
        box = self._box(places, float(beam.half_thickness.max()))
        body = (places, angle, beam.half_thickness, beam.taper, beam.spacing)
        i, j = box[0], box[1]
        cover_u, owner_u = _paint(
            *body, grid.h, SHIFT, grid.x[i.start : i.stop + 1], grid.yc[j], beam.clamped
        )
        cover_v, owner_v = _paint(
            *body, grid.h, SHIFT, grid.xc[i], grid.y[j.start : j.stop + 1], beam.clamped
        )
        faces_u = (slice(i.start, i.stop + 1), j)
        faces_v = (i, slice(j.start, j.stop + 1))
        if self._has_fixed:
            np.minimum(cover_u, 1.0 - self._fixed_u[faces_u], out=cover_u)
            np.minimum(cover_v, 1.0 - self._fixed_v[faces_v], out=cover_v)
        ahead_u, ahead_v = flow.ahead_u[faces_u], flow.ahead_v[faces_v]
        self.mass, momentum = _gather(
            places,
            (cover_u, owner_u, ahead_u, grid.x[faces_u[0]], grid.yc[j]),
            (cover_v, owner_v, ahead_v, grid.xc[i], grid.y[faces_v[1]]),
            self.density * grid.h**2,
        )
        moves = beam.motion(angle)
        flat = moves.reshape(-1, beam.size)
        heavy = self.mass.copy()
        heavy[:, range(3), range(3)] += beam.excess
        M = flat.T @ (heavy @ moves).reshape(-1, beam.size)
        driven = flat.T @ (momentum + beam.excess * self.velocity).ravel()
        reach = 0.5 * IMPLICIT * dt
        driven -= dt * (beam.K @ (beam.q + reach * beam.rate))
        if forces is not None:
            driven += dt * forces
        system = M + dt * (reach * beam.K + beam.D)
        free = np.ix_(beam.free, beam.free)
        rate = np.zeros(beam.size)
        rate[beam.free] = np.linalg.solve(system[free], driven[beam.free])
        self.velocity = moves @ rate
        self.force = ((self.mass @ self.velocity[:, :, None])[:, :, 0] - momentum) / dt
        _impose(self.velocity, places, cover_u, owner_u, ahead_u, grid.yc[j], True)
        _impose(self.velocity, places, cover_v, owner_v, ahead_v, grid.xc[i], False)
        beam.q = beam.q + dt * (0.5 * (rate + beam.rate) - travel)
        self._before, beam.rate = beam.rate, rate
        if self._has_fixed:
            cover_u = cover_u + self._fixed_u[faces_u]
            cover_v = cover_v + self._fixed_v[faces_v]
        freedom = self._freedom.copy()
        freedom[i, j] = _freedom(cover_u, cover_v)
        return freedom

    def _box(self, places: Array, half_thickness: float) -> tuple[slice, slice]:
        """The cells around the body; raises `LeftTheGrid` where they are not all small."""
        grid = self.flow.grid
        ranges = []
        for axis, edges in ((0, grid.x), (1, grid.y)):
            low = places[:, axis].min() - half_thickness - 2.0 * grid.h
            high = places[:, axis].max() + half_thickness + 2.0 * grid.h
            if not (edges[0] < low and high < edges[-1]):
                raise LeftTheGrid("the body left the water")
            first, last = np.searchsorted(edges, [low, high])
            ranges.append(slice(int(first) - 1, int(last)))
            sizes = np.diff(edges[ranges[-1].start : ranges[-1].stop + 1])
            if sizes.max() > 1.001 * grid.h:
                raise LeftTheGrid("the body left the part of the grid with small cells")
        return ranges[0], ranges[1]

    def state(self) -> dict[str, Array]:
        """Everything that the next step depends on, by name."""
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
        """Go on from what `state` gave."""
        self.flow.restore(state)
        if self.beam:
            self.beam.q, self.beam.rate = state["q"].copy(), state["rate"].copy()
            self._before, self.velocity = state["rate_before"].copy(), state["velocity"].copy()


def _freedom(cover_u: Array, cover_v: Array) -> Array:
    """0 in cells that are all body.

    A body that bends is longer on one side and shorter on the other: were its inner cells made free
    of divergence, it could bend the less the shorter the steps are.
    """
    return np.asarray(1.0 - cover_u[1:] * cover_u[:-1] * cover_v[:, 1:] * cover_v[:, :-1])


@njit(cache=True)
def _paint(  # pragma: no cover
    places: Array,
    angle: Array,
    half_thickness: Array,
    taper: Array,
    spacing: float,
    h: float,
    shift: float,
    px: Array,
    py: Array,
    clamped: bool,
) -> tuple[Array, NDArray[np.int64]]:
    """The share of each face that the body covers, and the slice nearest to it (−1: none)."""
    nx, ny = px.size, py.size
    cover, owner = np.zeros((nx, ny)), np.full((nx, ny), -1)
    nearest = np.full((nx, ny), np.inf)
    last = places.shape[0] - 1
    for s in range(last + 1):
        x, y = places[s, 0], places[s, 1]
        c, n = np.cos(angle[s]), np.sin(angle[s])
        reach = max(half_thickness[s], 0.5 * h) + h
        ends = s == 0 or s == last
        along_reach = spacing + (h if ends else 0.0)
        wide, high = abs(c) * along_reach + abs(n) * reach, abs(n) * along_reach + abs(c) * reach
        i0 = max(0, int(np.ceil((x - wide - px[0]) / h)))
        i1 = min(nx - 1, int((x + wide - px[0]) / h))
        j0 = max(0, int(np.ceil((y - high - py[0]) / h)))
        j1 = min(ny - 1, int((y + high - py[0]) / h))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                rx, ry = px[i] - x, py[j] - y
                along, across = rx * c + ry * n, abs(ry * c - rx * n)
                if abs(along) > along_reach:
                    continue
                distance = rx * rx + ry * ry
                if distance >= nearest[i, j]:
                    continue
                nearest[i, j] = distance
                half = max(half_thickness[s] + taper[s] * along, 0.5 * h)
                share = 0.5 - (across - half) / h - shift
                if s == last:
                    share = min(share, 0.5 - (along - 0.5 * spacing) / h - shift)
                elif s == 0 and not clamped:
                    share = min(share, 0.5 - (-along - 0.5 * spacing) / h - shift)
                cover[i, j] = min(max(share, 0.0), 1.0)
                owner[i, j] = s if share > 0.0 else -1
    return cover, owner


@njit(cache=True)
def _gather(  # pragma: no cover
    places: Array,
    on_u: tuple[Array, NDArray[np.int64], Array, Array, Array],
    on_v: tuple[Array, NDArray[np.int64], Array, Array, Array],
    mass: float,
) -> tuple[Array, Array]:
    """Mass matrix, shape (slices, 3, 3), and momentum, (slices, 3), of the water in each slice."""
    matrix, momentum = np.zeros((places.shape[0], 3, 3)), np.zeros((places.shape[0], 3))
    cover, owner, speed, px, py = on_u
    for i in range(px.size):
        for j in range(py.size):
            s = owner[i, j]
            if s < 0:
                continue
            m, lever = mass * cover[i, j], places[s, 1] - py[j]
            matrix[s, 0, 0] += m
            matrix[s, 0, 2] += m * lever
            matrix[s, 2, 2] += m * lever * lever
            momentum[s, 0] += m * speed[i, j]
            momentum[s, 2] += m * lever * speed[i, j]
    cover, owner, speed, px, py = on_v
    for i in range(px.size):
        for j in range(py.size):
            s = owner[i, j]
            if s < 0:
                continue
            m, lever = mass * cover[i, j], px[i] - places[s, 0]
            matrix[s, 1, 1] += m
            matrix[s, 1, 2] += m * lever
            matrix[s, 2, 2] += m * lever * lever
            momentum[s, 1] += m * speed[i, j]
            momentum[s, 2] += m * lever * speed[i, j]
    for s in range(places.shape[0]):
        matrix[s, 2, 0], matrix[s, 2, 1] = matrix[s, 0, 2], matrix[s, 1, 2]
    return matrix, momentum


@njit(cache=True)
def _impose(  # pragma: no cover
    velocity: Array,
    places: Array,
    cover: Array,
    owner: NDArray[np.int64],
    ahead: Array,
    other: Array,
    is_u: bool,
) -> None:
    """Give the covered faces the velocity of their slice.

    other: y of the faces for u, x of them for v [m]
    """
    for i in range(owner.shape[0]):
        for j in range(owner.shape[1]):
            s = owner[i, j]
            if s < 0:
                continue
            if is_u:
                wanted = velocity[s, 0] + velocity[s, 2] * (places[s, 1] - other[j])
            else:
                wanted = velocity[s, 1] + velocity[s, 2] * (other[i] - places[s, 0])
            ahead[i, j] += cover[i, j] * (wanted - ahead[i, j])
