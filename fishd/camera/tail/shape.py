"""Midline of a tail as a function of its fin angle, as learned."""

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

Array = NDArray[np.float64]
_ITERATIONS = 4


class Fit(NamedTuple):
    """Agreement of a midline with a shape."""

    alpha: float
    """Fin angle whose midline comes closest [rad]."""
    error: float
    """Root mean square of the distances that remain [px]."""
    alpha_error: float
    """Change of α that moves the midline by `error` [rad]."""
    turn: float
    """Angle by which the whole midline is turned about the root [rad]."""
    error_turned: float
    """Root mean square of the distances that remain after that turn [px]."""


class Shape:
    """Polynomials in α of the places of the stations along and across the axis."""

    def __init__(self, coefficients: Array, covariance: Array | None = None) -> None:
        """
        coefficients: of the powers of α from 0, shape (order, 2, stations) [px]
        covariance: of the distances of the stations from a midline, (stations, stations) [px²]
        """
        self.coefficients = coefficients
        stations = coefficients.shape[2]
        self.covariance = np.eye(stations) if covariance is None else covariance
        self._information = np.linalg.inv(self.covariance)
        self._derivative = polyder(coefficients)

    @classmethod
    def learn(cls, alpha: Array, points: Array, weight: Array, order: int) -> "Shape":
        """Return the polynomials that fit midlines best.

        alpha: fin angles, shape (n,) [rad]
        points: places along and across the axis, shape (n, stations, 2) [px]
        weight: shape (n, stations)
        """
        powers = alpha[:, None] ** np.arange(order)
        # A small penalty keeps the highest powers down where the span is narrow.
        penalty = 1e-3 * np.diag([0.0, 0.0, *np.ptp(alpha) ** np.arange(2.0, order)])
        known = weight.min(axis=1) > 0.0
        table = np.concatenate([powers[known], penalty])
        flat = points[known].transpose(0, 2, 1).reshape(int(known.sum()), -1)
        rows = np.concatenate([flat, np.zeros((order, flat.shape[1]))])
        coefficients = np.linalg.lstsq(table, rows, rcond=None)[0]
        return cls(coefficients.reshape(order, 2, -1))

    def midline(self, alpha: float) -> Array:
        """Return places along and across the axis, shape (stations, 2) [px]."""
        return np.asarray(polyval(alpha, self.coefficients).T)

    def change(self, alpha: float) -> Array:
        """Return the derivative of `midline` with α, shape (stations, 2) [px/rad]."""
        return np.asarray(polyval(alpha, self._derivative).T)

    def fit(self, points: Array, weight: Array, alpha: float, span: tuple[float, float]) -> Fit:
        """Return the agreement with a midline.

        alpha: fin angle to begin with [rad]
        span: range in which α is searched [rad]
        """
        alpha = min(max(alpha, span[0]), span[1])
        distance, total = np.zeros(len(points)), max(float(weight.sum()), 1e-9)
        for _ in range(_ITERATIONS):
            distance, slope, _normal = self._distances(points, alpha)
            step = float((weight * slope) @ distance) / max(float((weight * slope) @ slope), 1e-9)
            alpha = min(max(alpha + step, span[0]), span[1])
        distance, slope, normal = self._distances(points, alpha)
        error = float(np.sqrt(weight @ distance**2 / total))
        arm = self.midline(alpha) - self.coefficients[0, :, 0]
        turning = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        table = np.stack([slope, turning, np.ones(len(points))], axis=1)
        information, seen = self._information, np.flatnonzero(weight)
        if len(seen) < len(points):
            information = np.zeros_like(information)
            information[np.ix_(seen, seen)] = np.linalg.inv(self.covariance[np.ix_(seen, seen)])
        weighted = table.T @ information
        solution = np.linalg.lstsq(weighted @ table, weighted @ distance, rcond=None)[0]
        rest = distance - table @ solution
        error_turned = float(np.sqrt(weight @ rest**2 / total))
        alpha_error = error * math.sqrt(total / max(float(weight @ slope**2), 1e-9))
        return Fit(alpha, error, alpha_error, float(solution[1]), error_turned)

    def find_distances(self, points: Array, alpha: float) -> Array:
        """Return the distances of a midline from that at α, positive to higher rows [px]."""
        return self._distances(points, alpha)[0]

    def _distances(self, points: Array, alpha: float) -> tuple[Array, Array, Array]:
        """Return distances from the midline at α, its change with α, and its normals."""
        line = self.midline(alpha)
        tangent = np.gradient(line, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        change = self.change(alpha)
        return ((points - line) * normal).sum(axis=1), (change * normal).sum(axis=1), normal
