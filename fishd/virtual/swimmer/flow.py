"""Incompressible flow on a staggered grid that may travel: predict, then project.

Momentum is in conservative form, u_t + ∇·((u − w) u) = −∇p/ρ + ν ∇²u, with the velocity u in the
laboratory and w of the grid. Advection and diffusion use the second-order Adams–Bashforth scheme;
fluxes use the upwind-biased scheme of third order (κ = 1/3 in: van Leer, Upwind-difference
methods for aerodynamic problems governed by the Euler equations, Lectures in Applied Mathematics
22, 1985, pp. 327–336); incremental pressure projection (Van Kan, SIAM J. Sci. Stat. Comput. 7,
1986, doi:10.1137/0907059).

The fluxes have no limiter. Velocities, unlike densities, need not stay within bounds, and a limiter
treats every crest as an overshoot: with Koren's limiter, the error of a vortex in a stream is two
to eight times as large, and decreases with the second power of the cell size, not the third.
"""

from typing import Literal

import numpy as np
from numba import njit

from fishd.virtual.swimmer.grid import Array, Grid
from fishd.virtual.swimmer.poisson import Poisson

PAD = 2
"""Number of layers of ghost values around the velocities, the width of the stencil."""


class Flow:
    """Velocity and pressure on a grid between two walls, with an inlet on the left and an outlet.

    u has shape (nx + 1, ny) and v shape (nx, ny + 1) [m/s]; p, shape (nx, ny), is pressure over
    density [m²/s²].
    """

    def __init__(
        self,
        grid: Grid,
        viscosity: float,
        walls: Literal["slip", "no-slip"],
        inlet: Array | None = None,
    ) -> None:
        """viscosity: kinematic [m²/s]; inlet: u at the left side, shape (ny,); None for still water

        The flow starts at rest except at the inlet; change `inlet` over time to ramp it up.
        """
        self.grid = grid
        self.viscosity = viscosity
        self.inlet = np.zeros(grid.ny) if inlet is None else inlet
        self.grid_velocity = 0.0
        """Velocity w of the grid along x [m/s]."""
        self._slip = walls == "slip"
        self._poisson = Poisson(grid)
        self._u = np.zeros((grid.nx + 1 + 2 * PAD, grid.ny + 2 * PAD))
        self._v = np.zeros((grid.nx + 2 * PAD, grid.ny + 1 + 2 * PAD))
        self.u, self.v = self._u[PAD:-PAD, PAD:-PAD], self._v[PAD:-PAD, PAD:-PAD]
        self.p = np.zeros((grid.nx, grid.ny))
        self.ahead_u, self.ahead_v = np.zeros(self.u.shape), np.zeros(self.v.shape)
        """Predicted velocities at the end of the step; a body may change them before `project`."""
        self._rate_u, self._rate_v = np.zeros(self.u.shape), np.zeros(self.v.shape)
        self._started = False
        self._between_x = np.concatenate([grid.dx[:1], np.diff(grid.xc), grid.dx[-1:]])
        self._between_y = np.concatenate([grid.dy[:1], np.diff(grid.yc), grid.dy[-1:]])
        self._even_weight, self._source = np.ones(self.p.shape), np.empty(self.p.shape)
        self.boundary_impulse = 0.0
        """Momentum along x over density that crossed the boundaries in the latest step [m³/s]."""

    def predict(self, dt: float) -> None:
        """Compute `ahead_u` and `ahead_v`, the velocities after `dt` [s] without new pressure."""
        grid = self.grid
        self.u[0] = self.inlet
        _fill_ghosts(self._u, self._v, 1.0 if self._slip else -1.0)
        new = 1.5 if self._started else 1.0
        present = self._u, self._v, self.p
        sizes = grid.dx, grid.dy, self._between_x, self._between_y
        numbers = self.grid_velocity, self.viscosity, dt, new
        crossed = _advance_u(*present, self._rate_u, self.ahead_u, *sizes, *numbers)
        _advance_v(*present, self._rate_v, self.ahead_v, *sizes, *numbers)
        self._started = True
        self.boundary_impulse = dt * crossed
        self.ahead_u[0] = self.inlet
        self.ahead_v[:, 0] = self.ahead_v[:, -1] = 0.0
        self._update_outlet(dt)

    def _update_outlet(self, dt: float) -> None:
        """Set the velocities at the outlet, which are advected out with the speed of the tank.

        This simplifies Orlanski, doi:10.1016/0021-9991(76)90023-1, with a speed for each wave.
        """
        speed = max(0.0, float(self.grid.dy @ self.inlet) / float(self.grid.dy.sum()))
        speed = max(speed, -self.grid_velocity)
        share = min(1.0, speed * dt / self.grid.dx[-1])
        self.ahead_u[-1] = self.u[-1] - share * (self.u[-1] - self.u[-2])

    def project(self, dt: float, divergence_weight: Array | None = None) -> None:
        """Make the predicted velocities free of divergence, and store them in `u` and `v`.

        divergence_weight: shape (nx, ny), fraction of its divergence that each cell loses: 1 in
            water, 0 in cells inside a body, where the motion of the body applies
        """
        grid = self.grid
        weight = self._even_weight if divergence_weight is None else divergence_weight
        source = self._source
        _divergence(self.ahead_u, self.ahead_v, grid.dx, grid.dy, 1.0 / dt, weight, source)
        change = self._poisson.solve(source)
        before = grid.dy @ (self.p[-1] - self.p[0])
        sizes = self._between_x, self._between_y
        _correct(self.ahead_u, self.ahead_v, change, self.p, *sizes, dt, self.u, self.v)
        self.boundary_impulse -= dt * (before + float(grid.dy @ (change[-1] - change[0])))

    def momentum(self) -> float:
        """Return the momentum along x over density of all faces except those at the ends [m³/s]."""
        return float(self._between_x[1:-1] @ (self.u[1:-1] @ self.grid.dy))

    def courant_number(self, dt: float) -> float:
        """Return the largest (|u| / dx + |v| / dy) dt relative to the grid; NaN for NaN values."""
        return float(_courant(self.u, self.v, self.grid.dx, self.grid.dy, self.grid_velocity) * dt)

    def vorticity(self) -> Array:
        """Return ∂v/∂x − ∂u/∂y at the inner corners of cells [1/s], shape (nx − 1, ny − 1)."""
        dv = np.diff(self.v[:, 1:-1], axis=0) / self._between_x[1:-1, None]
        du = np.diff(self.u[1:-1], axis=1) / self._between_y[None, 1:-1]
        return np.asarray(dv - du)

    def state(self) -> dict[str, Array]:
        """Return the complete state by name."""
        return {
            "u": self.u.copy(),
            "v": self.v.copy(),
            "p": self.p.copy(),
            "rate_u": self._rate_u.copy(),
            "rate_v": self._rate_v.copy(),
            "grid_velocity": np.array(self.grid_velocity),
            "started": np.array(self._started),
        }

    def restore(self, state: dict[str, Array]) -> None:
        """Restore a result of `state`."""
        self.u[:], self.v[:], self.p[:] = state["u"], state["v"], state["p"]
        self._rate_u[:], self._rate_v[:] = state["rate_u"], state["rate_v"]
        self.grid_velocity = float(state["grid_velocity"])
        self._started = bool(state["started"])


@njit(cache=True)
def _fill_ghosts(u: Array, v: Array, mirror: float) -> None:  # pragma: no cover
    """Fill the ghost values; mirror: +1 for walls with slip, −1 without."""
    nx, ny = u.shape[0], v.shape[1]
    for k in range(PAD):
        inner, outer = PAD + k, PAD - 1 - k
        for i in range(u.shape[0]):
            u[i, outer] = mirror * u[i, inner]
            u[i, u.shape[1] - 1 - outer] = mirror * u[i, u.shape[1] - 1 - inner]
        for i in range(v.shape[0]):
            v[i, outer] = -v[i, inner + 1]
            v[i, ny - 1 - outer] = -v[i, ny - 2 - inner]
        for j in range(u.shape[1]):
            u[outer, j] = u[PAD, j]
            u[nx - 1 - outer, j] = u[nx - 1 - PAD, j]
        for j in range(ny):
            v[outer, j] = -v[inner, j]
            v[v.shape[0] - 1 - outer, j] = v[v.shape[0] - 1 - PAD, j]


@njit(inline="always")
def _advective_flux(  # pragma: no cover
    speed: float, before2: float, before: float, after: float, after2: float
) -> float:
    """Return the flux of a quantity through a face between two values on each side.

    The scheme is upwind-biased, and has third order where cells have equal sizes.
    """
    forward = speed > 0.0
    step = after - before if forward else before - after
    behind = before - before2 if forward else after - after2
    upwind = before if forward else after
    return speed * (upwind + (behind + 2.0 * step) / 6.0)


@njit(cache=True, fastmath={"contract", "nsz", "arcp"})
def _advance_u(  # pragma: no cover
    u: Array,
    v: Array,
    p: Array,
    rate: Array,
    ahead: Array,
    dx: Array,
    dy: Array,
    between_x: Array,
    between_y: Array,
    w: float,
    nu: float,
    dt: float,
    new: float,
) -> float:
    """Predict u on inner faces; return the momentum along x over density through boundaries."""
    nx, ny = dx.size, dy.size
    west, east, south = np.empty(ny), np.empty(ny), np.empty(ny + 1)
    old = 1.0 - new
    crossed = 0.0
    for i in range(nx):
        a = i + PAD
        for j in range(ny):
            b = j + PAD
            speed = 0.5 * (u[a, b] + u[a + 1, b]) - w
            east[j] = (
                _advective_flux(speed, u[a - 1, b], u[a, b], u[a + 1, b], u[a + 2, b])
                - nu * (u[a + 1, b] - u[a, b]) / dx[i]
            )
        if i == 0:
            for j in range(ny):
                crossed += east[j] * dy[j]
                west[j] = east[j]
            continue
        share = dx[i - 1] / (dx[i - 1] + dx[i])
        for j in range(ny + 1):
            b = j + PAD
            speed = share * v[a - 1, b] + (1.0 - share) * v[a, b]
            south[j] = (
                _advective_flux(speed, u[a, b - 2], u[a, b - 1], u[a, b], u[a, b + 1])
                - nu * (u[a, b] - u[a, b - 1]) / between_y[j]
            )
        crossed -= (south[ny] - south[0]) * between_x[i]
        inverse = 1.0 / between_x[i]
        for j in range(ny):
            now = -(east[j] - west[j]) * inverse - (south[j + 1] - south[j]) / dy[j]
            ahead[i, j] = u[a, j + PAD] + dt * (
                new * now + old * rate[i, j] - (p[i, j] - p[i - 1, j]) * inverse
            )
            crossed += old * (rate[i, j] - now) * between_x[i] * dy[j]
            rate[i, j] = now
            west[j] = east[j]
    for j in range(ny):
        crossed -= west[j] * dy[j]
    return crossed


@njit(cache=True, fastmath={"contract", "nsz", "arcp"})
def _advance_v(  # pragma: no cover
    u: Array,
    v: Array,
    p: Array,
    rate: Array,
    ahead: Array,
    dx: Array,
    dy: Array,
    between_x: Array,
    between_y: Array,
    w: float,
    nu: float,
    dt: float,
    new: float,
) -> None:
    """Predict v on inner faces."""
    nx, ny = dx.size, dy.size
    west, east, south = np.empty(ny + 1), np.empty(ny + 1), np.empty(ny)
    old = 1.0 - new
    for i in range(-1, nx):
        a = i + PAD
        for j in range(1, ny):  # flux through the face to the right of cell i
            b = j + PAD
            share = dy[j - 1] / (dy[j - 1] + dy[j])
            speed = share * u[a + 1, b - 1] + (1.0 - share) * u[a + 1, b] - w
            east[j] = (
                _advective_flux(speed, v[a - 1, b], v[a, b], v[a + 1, b], v[a + 2, b])
                - nu * (v[a + 1, b] - v[a, b]) / between_x[i + 1]
            )
        if i < 0:
            for j in range(1, ny):
                west[j] = east[j]
            continue
        for j in range(ny):
            b = j + PAD
            speed = 0.5 * (v[a, b] + v[a, b + 1])
            south[j] = (
                _advective_flux(speed, v[a, b - 1], v[a, b], v[a, b + 1], v[a, b + 2])
                - nu * (v[a, b + 1] - v[a, b]) / dy[j]
            )
        inverse = 1.0 / dx[i]
        for j in range(1, ny):
            now = -(east[j] - west[j]) * inverse - (south[j] - south[j - 1]) / between_y[j]
            ahead[i, j] = v[a, j + PAD] + dt * (
                new * now + old * rate[i, j] - (p[i, j] - p[i, j - 1]) / between_y[j]
            )
            rate[i, j] = now
            west[j] = east[j]


@njit(cache=True, fastmath=True)
def _divergence(  # pragma: no cover
    u: Array, v: Array, dx: Array, dy: Array, scale: float, divergence_weight: Array, out: Array
) -> None:
    for i in range(dx.size):
        along = scale / dx[i]
        for j in range(dy.size):
            here = (u[i + 1, j] - u[i, j]) * along + (v[i, j + 1] - v[i, j]) * scale / dy[j]
            out[i, j] = here * divergence_weight[i, j]


@njit(cache=True, fastmath=True)
def _correct(  # pragma: no cover
    ahead_u: Array,
    ahead_v: Array,
    change: Array,
    p: Array,
    between_x: Array,
    between_y: Array,
    dt: float,
    u: Array,
    v: Array,
) -> None:
    nx, ny = p.shape
    for j in range(ny):
        u[0, j] = ahead_u[0, j]
        u[nx, j] = ahead_u[nx, j] + dt * 2.0 * change[nx - 1, j] / between_x[nx]
    for i in range(nx):
        if i:
            inverse = dt / between_x[i]
            for j in range(ny):
                u[i, j] = ahead_u[i, j] - inverse * (change[i, j] - change[i - 1, j])
        v[i, 0] = v[i, ny] = 0.0
        for j in range(1, ny):
            v[i, j] = ahead_v[i, j] - dt * (change[i, j] - change[i, j - 1]) / between_y[j]
        for j in range(ny):
            p[i, j] += change[i, j]


@njit(cache=True)
def _courant(u: Array, v: Array, dx: Array, dy: Array, w: float) -> float:  # pragma: no cover
    worst = 0.0
    for i in range(dx.size):
        for j in range(dy.size):
            across = max(abs(v[i, j]), abs(v[i, j + 1])) / dy[j]
            here = max(abs(u[i, j] - w), abs(u[i + 1, j] - w)) / dx[i] + across
            if not np.isfinite(u[i, j] + u[i + 1, j] + v[i, j] + v[i, j + 1]):
                return np.nan
            worst = max(worst, here)
    return worst
