"""The fin, α̈ = −ξω₀α̇ − ω₀²(α − λφ) of Fu et al., over one stretch of time without a switch.

The fin is linear, so Gauss–Legendre collocation at N nodes becomes one matrix, worked out once for
a length of time: a step of the simulation is then a single product of that matrix with a vector.
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


_FINE: Vector = np.linspace(0.0, 1.0, 129)
_TO_FINE: Matrix = _interpolation(_FINE).T


class Segment:
    """What the fin makes of a drive during `length` seconds, for one set of parameters.

    Attributes:
        length: s.
        node_times: (N,), times of the nodes in units of Δ/Ω.
        node_decay: (N,), exp(−node_times).
        decay: exp(−length·Ω/Δ).
        response: (3N + 4, N + 3), from [α₀, α̇₀, λφ_c, lag/Δ at the nodes] to
            [α, α̇, α̈ at the nodes; α, α̇ at the end; Σα̈, Σα̇ over `instants`].
        sums: (2, N), from any quantity at the nodes to its [integral, sum over `instants`].
    """

    __slots__ = ("decay", "length", "node_decay", "node_times", "response", "sums")

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
        self.node_times: Vector = NODES * (length * servo_rate)
        self.node_decay: Vector = np.exp(-self.node_times)
        self.decay = math.exp(-length * servo_rate)
        self.response: Matrix = np.vstack(
            (motion, sampled @ motion[2 * N : 3 * N], sampled @ motion[N : 2 * N])
        )
        self.sums: Matrix = np.vstack((length * WEIGHTS, sampled))

    @property
    def free_motion(self) -> Matrix:
        """(2, 2), from [α₀, α̇₀] to [α, α̇] at the end when nothing drives the fin."""
        return self.response[3 * N : 3 * N + 2, :2]

    def peak(self, response: Vector) -> float:
        """Return the largest |α| (rad) within it, given the product `self.response @ …`."""
        angle, rate, acceleration = response[: 3 * N].reshape(3, N) @ _TO_FINE
        k = int(np.argmax(np.abs(angle)))
        if acceleration[k] == 0.0:
            return float(abs(angle[k]))
        # Between fine points, the vertex of the parabola there; an end may curve the other way.
        low, high = -_FINE[1] * (k > 0), _FINE[1] * (k < len(_FINE) - 1)
        time = np.clip(-rate[k] / acceleration[k], low * self.length, high * self.length)
        vertex = angle[k] + time * (rate[k] + 0.5 * time * acceleration[k])
        return float(max(abs(angle[k]), abs(vertex)))
