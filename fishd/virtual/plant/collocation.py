"""The fin, α̈ = −ξω₀α̇ − ω₀²(α − λφ) of Fu et al., over one stretch of time without a switch.

The fin is linear, so Gauss–Legendre collocation at N nodes becomes one matrix, worked out once for
a length of time: a step of the simulation is then a single product of that matrix with a vector.
Quadratic drag, −c |α̇| α̇ beside it, is found by Newton's method at the same nodes. Such a method is
B-stable (Hairer and Wanner, Solving ordinary differential equations II, IV.12): whatever the length
of the step, it has one solution for a drag, and errors do not grow.
"""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fishd.virtual.plant.parameters import PlantParameters

Vector: TypeAlias = NDArray[np.float64]  # shape (n,)
Matrix: TypeAlias = NDArray[np.float64]  # shape (m, n)

N = 12  # a segment one servo time constant long is then right to about 1e-10
_CLOSE = 1e-7  # of its largest rate: Newton's next step would be of the order of its square
_MOST = 60

_X, _W = np.polynomial.legendre.leggauss(N)  # on −1 … 1
NODES: Vector = 0.5 * (_X + 1.0)
WEIGHTS: Vector = 0.5 * _W


def _powers(points: Vector) -> Matrix:
    # On −1 … 1 the powers are a good enough basis for so few nodes: they cost 3e-13.
    return np.vander(2.0 * points - 1.0, N, increasing=True)


_COEFFICIENTS = np.linalg.inv(_powers(NODES))
_DEGREES = np.arange(1, N + 1)
_POWER_INTEGRALS: Matrix = 0.5 * (_X[:, None] ** _DEGREES - (-1.0) ** _DEGREES) / _DEGREES
_ONCE: Matrix = _POWER_INTEGRALS @ _COEFFICIENTS  # (N, N), from 0 to each node
_IDENTITY: Matrix = np.eye(N)

# From α̈ at the nodes of a segment of unit length to [α, α̇, α̈ at the nodes; α, α̇ at the end], from
# rest; each row is an integral of the order below, so it grows as that power of the length.
_INTEGRALS: Matrix = np.vstack((_ONCE @ _ONCE, _ONCE, _IDENTITY, WEIGHTS * (1.0 - NODES), WEIGHTS))
_ORDERS: Vector = np.repeat([2.0, 1.0, 0.0, 2.0, 1.0], [N, N, N, 1, 1])
# And what coasts on from the start: an angle by α₀ + t α̇₀, a rate by α̇₀.
_ANGLES: Vector = np.where(_ORDERS == 2.0, 1.0, 0.0)
_ANGLE_TIMES: Vector = _ANGLES * np.concatenate((NODES, NODES, NODES, [1.0, 1.0]))
_RATES: Vector = np.where(_ORDERS == 1.0, 1.0, 0.0)


def _interpolation(points: Vector) -> Matrix:
    """Return the (len(points), N) matrix from values at the nodes to values at points in 0 … 1."""
    return _powers(points) @ _COEFFICIENTS


def _with_sums(motion: Matrix, sampled: Vector) -> Matrix:
    """`motion`, and below it the sums over the instants that `sampled` (N,) stands for."""
    return np.vstack((motion, sampled @ motion[2 * N : 3 * N], sampled @ motion[N : 2 * N]))


_FINE: Vector = np.linspace(0.0, 1.0, 129)
_TO_FINE: Matrix = _interpolation(_FINE).T
_AT_AN_END = 1e-4  # of the length: a turn that is closer was cut there


class Segment:
    """What the fin makes of a drive during `length` seconds, for one set of parameters.

    Attributes:
        length: s.
        node_times: (N,), times of the nodes in units of Δ/Ω.
        node_decay: (N,), exp(−node_times).
        decay: exp(−length·Ω/Δ).
        response: (3N + 4, N + 3), from [α₀, α̇₀, λφ_c, lag/Δ at the nodes] to
            [α, α̇, α̈ at the nodes; α, α̇ at the end; Σα̈, Σα̇ over `instants`].
        pushed: (3N + 4, N), from further acceleration at the nodes to the same; None without
            quadratic drag.
        instants: those of the samples, s.
        sums: (2, N), from any quantity at the nodes to its [integral, sum over `instants`].
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
        """Prepare a segment of `length` s, to be sampled at `instants` (s, from its start)."""
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
        """(2, 2), from [α₀, α̇₀] to [α, α̇] at the end when nothing drives the fin."""
        return self.response[3 * N : 3 * N + 2, :2]

    def braked(self, cause: Vector, drag: float) -> Vector:
        """Return `response @ cause` for a fin with quadratic drag (1/rad).

        Raises `ArithmeticError` where Newton's method finds none.
        """
        assert self.pushed is not None
        free: Vector = self.response.dot(cause)
        coasting = free[N : 2 * N]
        slowed = 2.0 * drag * self.pushed[N : 2 * N]
        rates = coasting
        for _ in range(_MOST):
            size = np.abs(rates)
            error = rates - coasting + 0.5 * slowed @ (size * rates)
            step = np.linalg.solve(_IDENTITY + slowed * size, error)
            rates = rates - step
            if np.abs(step).max() <= _CLOSE * np.abs(rates).max():
                return free - self.pushed @ (drag * np.abs(rates) * rates)
        raise ArithmeticError(f"no fin with a quadratic drag of {drag:g} 1/rad can move so fast")

    def turn(self, response: Vector) -> float:
        """Return when (s) the fin first turns, given the response; 0 for not, or at an end only."""
        rates = response[N : 2 * N] @ _TO_FINE
        for k in np.flatnonzero(rates[1:] * rates[:-1] < 0.0):
            share = float(_FINE[k] + _FINE[1] * rates[k] / (rates[k] - rates[k + 1]))
            if _AT_AN_END < share < 1.0 - _AT_AN_END:
                return self.length * share
        return 0.0

    def peak(self, response: Vector) -> float:
        """Return the largest |α| (rad) within it, given the product `self.response @ …`."""
        angles = response[:N].dot(_TO_FINE)
        k = int(np.abs(angles).argmax())
        motion: list[float] = response[: 3 * N].reshape(3, N).dot(_TO_FINE[:, k]).tolist()
        angle, rate, acceleration = motion
        if acceleration == 0.0:
            return abs(angle)
        # Between fine points, the vertex of the parabola there; an end may curve the other way.
        low, high = -_FINE[1] * (k > 0), _FINE[1] * (k < len(_FINE) - 1)
        time = max(low * self.length, min(high * self.length, -rate / acceleration))
        vertex = angle + time * (rate + 0.5 * time * acceleration)
        return float(max(abs(angle), abs(vertex)))
