"""Incompressible flow on a staggered grid that may travel: predict, then project.

Momentum is in conservative form, u_t + ∇·((u − w) u) = −∇p/ρ + ν ∇²u, with the velocity u in the
laboratory and w of the grid. Advection and diffusion N(u) use the third-order Adams–Bashforth
scheme, and fluxes the fourth-order central scheme with a part of the dissipation of the
upwind-biased scheme of third order (κ = 1/3 in: van Leer, Upwind-difference methods for aerodynamic
problems governed by the Euler equations, Lectures in Applied Mathematics 22, 1985, pp. 327–336);
incremental pressure projection (Van Kan, SIAM J. Sci. Stat. Comput. 7, 1986, doi:10.1137/0907059).

The fluxes have no limiter. Velocities, unlike densities, need not stay within bounds, and a limiter
treats every crest as an overshoot: with Koren's limiter, the error of a vortex in a stream is two
to eight times as large, and decreases with the second power of the cell size, not the third.

Fields have the precision `dtype`, single by default; sums of momentum are of double precision.
"""

from typing import Any, Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import DTypeLike

from fishd.virtual.swimmer.grid import Array, Field, Grid
from fishd.virtual.swimmer.poisson import Poisson
from fishd.virtual.swimmer.settings import DISSIPATION

PAD = 2
"""Number of layers of ghost values around the velocities, the width of the stencil."""
ADAMS_BASHFORTH = np.array(
    [[1.0, 0.0, 0.0], [1.5, -0.5, 0.0], [23.0 / 12.0, -16.0 / 12.0, 5.0 / 12.0]]
)
"""Weights of the newest rate and the two before, after 0, 1, and 2 or more steps."""


class Stencil(NamedTuple):
    """Sizes of the volumes around the values of one velocity component, inside the boundaries.

    u is inside at 1 ≤ i < nx, and v at 1 ≤ j < ny. Arrays along x count i, arrays along y count j,
    from the first value inside.
    """

    size_x: Array
    """Width of the volume around each value [m]."""
    size_y: Array
    """Height of that volume [m]."""
    inverse_size_x: Field
    inverse_size_y: Field
    inverse_gap_x: Field
    """Inverse distances of values to those before, and of the last to that after it [1/m]."""
    inverse_gap_y: Field
    weight_x: Field
    """Weights, for each j, of the first of the two values of u whose mean flows through the right
    side of the volume: the left one for the volumes of u, the lower one for those of v."""
    weight_y: Field
    """Weights, for each i, of the first of the two values of v whose mean flows through the lower
    side: the left one for the volumes of u, the lower one for those of v."""


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
        dtype: DTypeLike = np.float32,
    ) -> None:
        """viscosity: kinematic [m²/s]; inlet: u at the left side, shape (ny,); None for still water

        The flow starts at rest except at the inlet; change `inlet` over time to ramp it up.
        """
        self.grid = grid
        self.viscosity = viscosity
        self.inlet = np.zeros(grid.ny) if inlet is None else inlet
        self.grid_velocity = np.zeros(2)
        """Velocity w of the grid [m/s]; along y only between walls with slip, which water that is
        at rest then passes."""
        self._slip = walls == "slip"
        self._poisson = Poisson(grid, dtype)
        self.pairs = self._poisson.pairs
        """Threads for the two halves of a step."""
        self._u = np.zeros((grid.nx + 1 + 2 * PAD, grid.ny + 2 * PAD), dtype)
        self._v = np.zeros((grid.nx + 2 * PAD, grid.ny + 1 + 2 * PAD), dtype)
        self.u, self.v = self._u[PAD:-PAD, PAD:-PAD], self._v[PAD:-PAD, PAD:-PAD]
        self.p = np.zeros((grid.nx, grid.ny), dtype)
        self.predicted_u, self.predicted_v = np.zeros_like(self.u), np.zeros_like(self.v)
        """Velocities u* at the end of the step before the new pressure acts; a body may change them
        before `project`."""
        self._rates_u = [np.zeros_like(self.u) for _ in range(3)]
        self._rates_v = [np.zeros_like(self.v) for _ in range(3)]
        """N(u) of the latest three steps, the newest first."""
        self._crossed = np.zeros(3)
        """Sum of N(u) along x over all inner faces at these steps, from the boundaries [m³/s²]."""
        self._past_steps = 0
        """Number of steps whose rates are known, at most 2."""
        # Distances between the centres of cells; at the ends, those to the mirror images.
        self._between_x = np.concatenate([grid.dx[:1], np.diff(grid.xc), grid.dx[-1:]])
        self._between_y = np.concatenate([grid.dy[:1], np.diff(grid.yc), grid.dy[-1:]])
        halves = np.full(grid.nx, 0.5), np.full(grid.ny, 0.5)
        self._stencils = (
            _stencil(
                (self._between_x[1:-1], grid.dy),
                (grid.dx, self._between_y),
                (halves[1], _weights(grid.dx)),
                dtype,
            ),
            _stencil(
                (grid.dx, self._between_y[1:-1]),
                (self._between_x, grid.dy),
                (_weights(grid.dy), halves[0]),
                dtype,
            ),
        )
        self._even_weight, self._source = np.ones_like(self.p), np.empty_like(self.p)
        self.boundary_impulse = 0.0
        """Momentum along x over density that crossed the boundaries in the latest step [m³/s]."""

    def predict(self, dt: float) -> None:
        """Compute u*, the velocities after `dt` [s] without new pressure."""
        self.u[0] = self.inlet
        _fill_ghosts(self._u, self._v, 1.0 if self._slip else -1.0)
        weights = ADAMS_BASHFORTH[self._past_steps]
        scalars = *self.grid_velocity, self.viscosity, dt, *weights
        rates_u, rates_v = self._rates_u, self._rates_v
        rates_u.insert(0, rates_u.pop())
        rates_v.insert(0, rates_v.pop())
        fields, (on_u, on_v) = (self._u, self._v, self.p), self._stencils
        crossed, _ = self.pairs.run(
            lambda: _advance(0, self._u, *fields, *rates_u, self.predicted_u, on_u, *scalars),
            lambda: _advance(1, self._v, *fields, *rates_v, self.predicted_v, on_v, *scalars),
        )
        self._crossed = np.array([crossed, *self._crossed[:2]])
        self._past_steps = min(2, self._past_steps + 1)
        self.boundary_impulse = dt * float(weights @ self._crossed)
        self.predicted_u[0] = self.inlet
        self.predicted_v[:, 0] = self.predicted_v[:, -1] = 0.0
        self._update_outlet(dt)

    def _update_outlet(self, dt: float) -> None:
        """Set the velocities at the outlet, which are advected out with the speed of the tank.

        This simplifies Orlanski, doi:10.1016/0021-9991(76)90023-1, with a speed for each wave.
        """
        speed = max(0.0, float(self.grid.dy @ self.inlet) / float(self.grid.dy.sum()))
        speed = max(speed, -float(self.grid_velocity[0]))
        passed = min(1.0, speed * dt / float(self.grid.dx[-1]))
        self.predicted_u[-1] = self.u[-1] - passed * (self.u[-1] - self.u[-2])

    def project(self, dt: float, divergence_weight: Field | None = None) -> None:
        """Make the predicted velocities free of divergence, and store them in `u` and `v`.

        divergence_weight: shape (nx, ny), fraction of its divergence that each cell loses: 1 in
            water, 0 in cells inside a body, where the motion of the body applies
        """
        grid = self.grid
        weight = self._even_weight if divergence_weight is None else divergence_weight
        source = self._source
        predicted = self.predicted_u, self.predicted_v
        on_u, on_v = self._stencils
        sizes = on_v.inverse_size_x, on_u.inverse_size_y
        _divergence(*predicted, *sizes, 1.0 / dt, weight, source)
        change = self._poisson.solve(source)
        before = grid.dy @ (self.p[-1] - self.p[0])
        self.pairs.run(
            lambda: _correct_u(self.predicted_u, change, on_u.inverse_size_x, dt, self._u),
            lambda: _correct_v(self.predicted_v, change, on_v.inverse_size_y, dt, self._v),
        )
        self.u[0] = self.predicted_u[0]
        beyond = self.u.dtype.type(2.0 * dt / self._between_x[-1])
        self.u[-1] = self.predicted_u[-1] + beyond * change[-1]
        self.v[:, 0] = self.v[:, -1] = 0.0
        self.p += change
        self.boundary_impulse -= dt * float(before + grid.dy @ (change[-1] - change[0]))

    def momentum(self) -> float:
        """Return the momentum along x over density of all faces except those at the ends [m³/s]."""
        return float(self._between_x[1:-1] @ (self.u[1:-1] @ self.grid.dy))

    def courant_number(self, dt: float) -> float:
        """Return the largest (|u| / dx + |v| / dy) dt relative to the grid; NaN for NaN values."""
        w = self.grid_velocity
        return float(_courant(self.u, self.v, self.grid.dx, self.grid.dy, w) * dt)

    def vorticity(self) -> Array:
        """Return ∂v/∂x − ∂u/∂y at the inner corners of cells [1/s], shape (nx − 1, ny − 1)."""
        dv = np.diff(self.v[:, 1:-1], axis=0) / self._between_x[1:-1, None]
        du = np.diff(self.u[1:-1], axis=1) / self._between_y[None, 1:-1]
        return np.asarray(dv - du, np.float64)

    def state(self) -> dict[str, Any]:
        """Return the complete state by name."""
        return {
            "u": self.u.copy(),
            "v": self.v.copy(),
            "p": self.p.copy(),
            "rates_u": np.array(self._rates_u[:2]),
            "rates_v": np.array(self._rates_v[:2]),
            "crossed": self._crossed.copy(),
            "grid_velocity": self.grid_velocity.copy(),
            "past_steps": np.array(self._past_steps),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a result of `state`."""
        self.u[:], self.v[:], self.p[:] = state["u"], state["v"], state["p"]
        for rates, stored in (
            (self._rates_u, state["rates_u"]),
            (self._rates_v, state["rates_v"]),
        ):
            rates[0][:], rates[1][:] = stored
        self._crossed = state["crossed"].copy()
        self.grid_velocity = state["grid_velocity"].copy()
        self._past_steps = int(state["past_steps"])


def _stencil(
    sizes: tuple[Array, Array],
    gaps: tuple[Array, Array],
    weights: tuple[Array, Array],
    dtype: DTypeLike,
) -> Stencil:
    """Return the stencil; each pair is along x and along y, and in the order of `Stencil`."""
    inverses = (1.0 / values for values in (*sizes, *gaps))
    fields = (np.ascontiguousarray(values, dtype) for values in (*inverses, *weights))
    return Stencil(*(np.ascontiguousarray(size) for size in sizes), *fields)


def _weights(sizes: Array) -> Array:
    """Return the weight of the first value in the mean of each pair of neighbours."""
    return np.asarray(sizes[:-1] / (sizes[:-1] + sizes[1:]))


@njit(cache=True)
def _fill_ghosts(u: Field, v: Field, mirror: float) -> None:  # pragma: no cover
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
def face_flux(  # pragma: no cover
    speed: Any, before2: Any, before: Any, after: Any, after2: Any, weights: Any
) -> Any:
    """Return the flux of a quantity through a face between two values on each side.

    It is the central flux, of fourth order where cells have equal sizes, and a dissipation that is
    |speed| times a third difference of the values.

    weights: those of the inner values, the outer values and the third difference
    """
    central, outer, dissipation = weights
    step = after - before
    third = after2 - before2 - (step + step + step)
    return speed * (central * (before + after) - outer * (before2 + after2)) + (
        dissipation * abs(speed) * third
    )


@njit(inline="always")
def flux_weights(real: Any) -> Any:  # pragma: no cover
    """Return the weights of `face_flux` as numbers of the type `real`."""
    return real(7.0 / 12.0), real(1.0 / 12.0), real(DISSIPATION / 12.0)


@njit(cache=True, nogil=True, fastmath={"contract", "nsz", "arcp"})
def _advance(  # pragma: no cover
    k: int,
    q: Field,
    u: Field,
    v: Field,
    p: Field,
    rate: Field,
    rate1: Field,
    rate2: Field,
    predicted: Field,
    stencil: Stencil,
    wx: float,
    wy: float,
    nu: float,
    dt: float,
    new: float,
    old: float,
    older: float,
) -> float:
    """Predict one component inside the boundaries; return the sum of N(u) times the volumes.

    k: 0 for u, 1 for v; q: that component, with its ghost values
    rate: N(u), an output; rate1, rate2: those of the two steps before
    wx, wy: velocity of the grid; nu: viscosity; new, old, older: weights of the three rates
    """
    real = q.dtype.type
    weights = flux_weights(real)
    speed_x, speed_y, viscosity = real(wx), real(wy), real(nu)
    step, zero, one = real(dt), real(0.0), real(1.0)
    a0, a1, a2 = real(dt * new), real(dt * old), real(dt * older)
    first_i, first_j = 1 - k, k
    rows, n = stencil.size_x.size, stencil.size_y.size
    low, high = PAD + first_j, PAD + first_j + n
    west, east, south = np.empty(n, q.dtype), np.empty(n, q.dtype), np.empty(n + 1, q.dtype)
    weight_x, inverse_gap_y = stencil.weight_x[:n], stencil.inverse_gap_y[: n + 1]
    inverse_y = stencil.inverse_size_y[:n]
    crossed = 0.0
    for row in range(-1, rows):
        i = first_i + row
        a = i + PAD
        before2, before = q[a - 1, low:high], q[a, low:high]
        after, after2 = q[a + 1, low:high], q[a + 2, low:high]
        left, right = u[a + k, low - k : high - k], u[a + 1, low:high]
        diffusion = viscosity * stencil.inverse_gap_x[row + 1]
        for j in range(n):
            speed = weight_x[j] * left[j] + (one - weight_x[j]) * right[j] - speed_x
            east[j] = face_flux(speed, before2[j], before[j], after[j], after2[j], weights) - (
                diffusion * (after[j] - before[j])
            )
        if row < 0 or row == rows - 1:
            outwards = 0.0
            for j in range(n):
                outwards += east[j] * stencil.size_y[j]
            crossed += outwards if row < 0 else -outwards
        if row >= 0:
            below2, below = q[a, low - 2 : high - 1], q[a, low - 1 : high]
            above, above2 = q[a, low : high + 1], q[a, low + 1 : high + 2]
            lower, upper = v[a - 1 + k, low - k : high + 1 - k], v[a, low : high + 1]
            weight_y = stencil.weight_y[row]
            for j in range(n + 1):
                speed = weight_y * lower[j] + (one - weight_y) * upper[j] - speed_y
                south[j] = face_flux(speed, below2[j], below[j], above[j], above2[j], weights) - (
                    viscosity * inverse_gap_y[j] * (above[j] - below[j])
                )
            crossed -= (float(south[n]) - float(south[0])) * stencil.size_x[row]
            inverse_x = stencil.inverse_size_x[row]
            along, across = (inverse_x, zero) if k == 0 else (zero, one)
            after_p, before_p = p[i, first_j : first_j + n], p[i - 1 + k, :n]
            now, then = rate[i, first_j : first_j + n], rate1[i, first_j : first_j + n]
            earlier, out = rate2[i, first_j : first_j + n], predicted[i, first_j : first_j + n]
            # Two loops, because a compiler can only vectorise loops over few arrays.
            for j in range(n):
                now[j] = (west[j] - east[j]) * inverse_x + (south[j] - south[j + 1]) * inverse_y[j]
            for j in range(n):
                slope = (after_p[j] - before_p[j]) * (along + across * inverse_y[j])
                out[j] = before[j] + (a0 * now[j] + a1 * then[j] + a2 * earlier[j] - step * slope)
        west, east = east, west
    return crossed


@njit(cache=True, fastmath=True)
def _divergence(  # pragma: no cover
    u: Field,
    v: Field,
    inverse_dx: Field,
    inverse_dy: Field,
    scale: float,
    weight: Field,
    out: Field,
) -> None:
    """Write `scale` times the weighted divergence."""
    factor = out.dtype.type(scale)
    nx, ny = out.shape
    for i in range(nx):
        along = factor * inverse_dx[i]
        left, right, lower, upper = u[i], u[i + 1], v[i, :ny], v[i, 1:]
        for j in range(ny):
            across = (upper[j] - lower[j]) * (factor * inverse_dy[j])
            out[i, j] = ((right[j] - left[j]) * along + across) * weight[i, j]


@njit(cache=True, nogil=True, fastmath=True)
def _correct_u(  # pragma: no cover
    predicted: Field, change: Field, inverse_size: Field, dt: float, u: Field
) -> None:
    """Write u* minus Δt times the gradient of the change of pressure, inside the boundaries.

    u: an output, with its ghost values
    """
    nx, ny = change.shape
    for i in range(1, nx):
        scale = u.dtype.type(dt) * inverse_size[i - 1]
        out = u[i + PAD, PAD : PAD + ny]
        for j in range(ny):
            out[j] = predicted[i, j] - scale * (change[i, j] - change[i - 1, j])


@njit(cache=True, nogil=True, fastmath=True)
def _correct_v(  # pragma: no cover
    predicted: Field, change: Field, inverse_size: Field, dt: float, v: Field
) -> None:
    """Write v* minus Δt times the gradient of the change of pressure, inside the boundaries.

    v: an output, with its ghost values
    """
    nx, ny = change.shape
    step = v.dtype.type(dt)
    for i in range(nx):
        out, before = v[i + PAD, PAD + 1 : PAD + ny], predicted[i, 1:ny]
        below, above = change[i, : ny - 1], change[i, 1:]
        for j in range(ny - 1):
            out[j] = before[j] - step * inverse_size[j] * (above[j] - below[j])


@njit(cache=True)
def _courant(u: Field, v: Field, dx: Array, dy: Array, w: Array) -> float:  # pragma: no cover
    worst = 0.0
    for i in range(dx.size):
        for j in range(dy.size):
            across = max(abs(v[i, j] - w[1]), abs(v[i, j + 1] - w[1])) / dy[j]
            here = max(abs(u[i, j] - w[0]), abs(u[i + 1, j] - w[0])) / dx[i] + across
            if not np.isfinite(u[i, j] + u[i + 1, j] + v[i, j] + v[i, j + 1]):
                return np.nan
            worst = max(worst, here)
    return worst
