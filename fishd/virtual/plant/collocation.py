"""Motion of the fin, α̈ = −ξω₀α̇ − ω₀²(α − λφ) of Fu et al., over a segment of time without a switch.

The fin is linear, so Gauss–Legendre collocation at N nodes is one matrix, computed once for each
length of time: a step of the simulation is a single product of that matrix and a vector. Quadratic
drag, the additional term −c |α̇| α̇, is solved by Newton's method at the same nodes. This method is
B-stable (Hairer and Wanner, Solving ordinary differential equations II, IV.12): for any length of
the step it has one solution for a drag, and errors do not grow.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.plant.parameters import PlantParameters

Vector: TypeAlias = NDArray[np.float64]  # shape (n,)
Matrix: TypeAlias = NDArray[np.float64]  # shape (m, n)

N = 12
"""Number of nodes; the error of a segment of one servo time constant is about 1e-10."""
_NEWTON_TOLERANCE = 1e-7
"""Largest last step of Newton's method, relative to the largest rate; the next step would have the
order of its square."""
_MAX_ITERATIONS = 60

_X, _W = np.polynomial.legendre.leggauss(N)  # on −1 … 1
NODES: Vector = 0.5 * (_X + 1.0)
WEIGHTS: Vector = 0.5 * _W


def _powers(points: Vector) -> Matrix:
    # On −1 … 1, powers are a sufficient basis for 12 nodes: their error is 3e-13.
    return np.vander(2.0 * points - 1.0, N, increasing=True)


_COEFFICIENTS = np.linalg.inv(_powers(NODES))
_DEGREES = np.arange(1, N + 1)
_POWER_INTEGRALS: Matrix = 0.5 * (_X[:, None] ** _DEGREES - (-1.0) ** _DEGREES) / _DEGREES
_INTEGRATION: Matrix = _POWER_INTEGRALS @ _COEFFICIENTS  # (N, N), from 0 to each node
_IDENTITY: Matrix = np.eye(N)

# Matrix from α̈ at the nodes of a segment of unit length to [α, α̇, α̈ at the nodes; α, α̇ at the
# end], starting at rest. Each row is an integral of the order in _ORDERS: that power of the length.
_INTEGRALS: Matrix = np.vstack(
    (_INTEGRATION @ _INTEGRATION, _INTEGRATION, _IDENTITY, WEIGHTS * (1.0 - NODES), WEIGHTS)
)
_ORDERS: Vector = np.repeat([2.0, 1.0, 0.0, 2.0, 1.0], [N, N, N, 1, 1])
# Contribution of the start: α₀ + t α̇₀ to an angle, α̇₀ to a rate.
_ANGLES: Vector = np.where(_ORDERS == 2.0, 1.0, 0.0)
_ANGLE_TIMES: Vector = _ANGLES * np.concatenate((NODES, NODES, NODES, [1.0, 1.0]))
_RATES: Vector = np.where(_ORDERS == 1.0, 1.0, 0.0)


def _interpolation(points: Vector) -> Matrix:
    """Return the (len(points), N) matrix from values at the nodes to values at points in 0 … 1."""
    return _powers(points) @ _COEFFICIENTS


def _with_sums(motion: Matrix, sampled: Vector) -> Matrix:
    """Return `motion` with two more rows, sums over the instants with weights `sampled` (N,)."""
    return np.vstack((motion, sampled @ motion[2 * N : 3 * N], sampled @ motion[N : 2 * N]))


_FINE: Vector = np.linspace(0.0, 1.0, 129)
_TO_FINE: Matrix = _interpolation(_FINE).T
_END_TOLERANCE = 1e-4  # fraction of the length; a reversal closer to an end was cut there


class Segment:
    """Linear response of the fin to its drive during `length` seconds, for one set of parameters.

    Attributes:
        length: [s].
        node_times: (N,), times of the nodes in units of Δ/Ω.
        node_decay: (N,), exp(−node_times).
        decay: exp(−length·Ω/Δ).
        response: (3N + 4, N + 3), matrix from [α₀, α̇₀, λφ_c, lag/Δ at the nodes] to
            [α, α̇, α̈ at the nodes; α, α̇ at the end; Σα̈, Σα̇ over `instants`].
        pushed: (3N + 4, N), matrix from additional acceleration at the nodes to the same; None
            without quadratic drag.
        instants: times of the samples [s].
        sums: (2, N), matrix from any quantity at the nodes to its [integral, sum over `instants`].
    """

    __slots__ = (
        "decay",
        "instants",
        "length",
        "node_decay",
        "node_times",
        "pushed",
        "response",
        "sums",
    )

    def __init__(
        self, parameters: PlantParameters, length: float, instants: Sequence[float]
    ) -> None:
        """Prepare a segment of `length` s with samples at `instants` (s, from its start)."""
        friction = parameters.xi * parameters.omega0
        stiffness = parameters.omega0**2
        servo_rate = parameters.servo_speed / parameters.servo_lag

        cause = np.empty((N, N + 3))
        cause[:, 0] = -stiffness
        cause[:, 1] = -friction - stiffness * length * NODES
        cause[:, 2] = stiffness
        cause[:, 3:] = (-stiffness * parameters.coupling * parameters.servo_lag) * _IDENTITY
        integrals = _INTEGRALS * (length**_ORDERS)[:, None]
        collocation = _IDENTITY + friction * integrals[N : 2 * N] + stiffness * integrals[:N]
        motion = integrals @ np.linalg.solve(collocation, cause)
        motion[:, 0] += _ANGLES
        motion[:, 1] += length * _ANGLE_TIMES + _RATES
        sampled = _interpolation(np.asarray(instants, dtype=np.float64) / length).sum(axis=0)

        self.length = length
        self.instants = instants
        self.node_times: Vector = NODES * (length * servo_rate)
        self.node_decay: Vector = np.exp(-self.node_times)
        self.decay = math.exp(-length * servo_rate)
        self.response = _with_sums(motion, sampled)
        self.pushed: Matrix | None = None
        if parameters.quadratic_drag:
            self.pushed = _with_sums(integrals @ np.linalg.inv(collocation), sampled)
        self.sums: Matrix = np.vstack((length * WEIGHTS, sampled))

    @property
    def free_motion(self) -> Matrix:
        """(2, 2) matrix from [α₀, α̇₀] to [α, α̇] at the end without a drive."""
        return self.response[3 * N : 3 * N + 2, :2]

    def braked(self, cause: Vector, drag: float) -> Vector:
        """Return `response @ cause` for a fin with quadratic drag (1/rad).

        Raises `ArithmeticError` where Newton's method does not converge.
        """
        assert self.pushed is not None
        free: Vector = self.response.dot(cause)
        coasting = free[N : 2 * N]
        slowed = 2.0 * drag * self.pushed[N : 2 * N]
        rates = coasting
        for _ in range(_MAX_ITERATIONS):
            size = np.abs(rates)
            error = rates - coasting + 0.5 * slowed @ (size * rates)
            step = np.linalg.solve(_IDENTITY + slowed * size, error)
            rates = rates - step
            if np.abs(step).max() <= _NEWTON_TOLERANCE * np.abs(rates).max():
                return free - self.pushed @ (drag * np.abs(rates) * rates)
        raise ArithmeticError(f"no fin with a quadratic drag of {drag:g} 1/rad can move so fast")

    def turn(self, response: Vector) -> float:
        """Return the time (s) of the fin's first reversal, given the response; 0 without one."""
        rates = response[N : 2 * N] @ _TO_FINE
        for k in np.flatnonzero(rates[1:] * rates[:-1] < 0.0):
            fraction = float(_FINE[k] + _FINE[1] * rates[k] / (rates[k] - rates[k + 1]))
            if _END_TOLERANCE < fraction < 1.0 - _END_TOLERANCE:
                return self.length * fraction
        return 0.0

    def peak(self, response: Vector) -> float:
        """Return the largest |α| (rad) in the segment, given the product `self.response @ …`."""
        angles = response[:N].dot(_TO_FINE)
        k = int(np.abs(angles).argmax())
        motion: list[float] = response[: 3 * N].reshape(3, N).dot(_TO_FINE[:, k]).tolist()
        angle, rate, acceleration = motion
        if acceleration == 0.0:
            return abs(angle)
        # Vertex of the parabola at this fine point; at an end it may lie outside the segment.
        low, high = -_FINE[1] * (k > 0), _FINE[1] * (k < len(_FINE) - 1)
        time = max(low * self.length, min(high * self.length, -rate / acceleration))
        vertex = angle + time * (rate + 0.5 * time * acceleration)
        return float(max(abs(angle), abs(vertex)))
