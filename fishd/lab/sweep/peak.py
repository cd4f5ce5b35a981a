"""Maximum of a measured curve, with its interval, by a parabola through the upper part."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fishd.lab.statistics import Z95, student95

UPPER_FRACTION = 0.85
"""Fraction of the highest value above which neighbouring points belong to the parabola."""
MIN_POINTS = 5
"""Smallest number of points of the parabola if the curve has as many; at least three."""


class Peak(NamedTuple):
    """Maximum of a curve y(x), in the units of x and y."""

    x: float
    """Position of the maximum."""
    x_low: float | None
    """Lower end of the 95 % confidence interval of `x`; None if the points do not determine it."""
    x_high: float | None
    """Upper end of that interval."""
    y: float
    """Value at the maximum."""
    y_error: float | None
    """Half-width of the 95 % confidence interval of `y`."""
    at_edge: bool
    """Whether the highest value is the first or the last, so that the maximum may lie beyond."""
    coefficients: tuple[float, float, float] | None
    """Coefficients a, b, c of the parabola a·(x − x₀)² + b·(x − x₀) + c; None if there is none."""
    centre: float
    """x₀ of the parabola."""
    span: tuple[float, float]
    """Range of x to which the parabola was fitted."""


def find_peak(x: Sequence[float], y: Sequence[float], error: Sequence[float | None]) -> Peak:
    """Return the maximum of y over x.

    error: half-width of the 95 % confidence interval of each y; None if it is unknown

    The interval is that of the vertex of a weighted least-squares parabola. The variance of a value
    is that of its own error plus the misfit of the parabola, which the residuals show.
    Raises ValueError if there are no points.
    """
    order = np.argsort(x)
    xs, ys = _to_array(x)[order], _to_array(y)[order]
    deviations = np.array([(half_width or 0.0) / Z95 for half_width in error])[order]
    if not len(xs):
        raise ValueError("a curve without points has no maximum")
    top = int(np.argmax(ys))
    first, last = _select_points(ys, top)
    selection = slice(first, last + 1)
    highest = error[int(order[top])]
    at_edge = top in (0, len(xs) - 1)
    without_parabola = Peak(
        float(xs[top]), None, None, float(ys[top]), highest, at_edge, None, float(xs[top]),
        (float(xs[first]), float(xs[last])),
    )  # fmt: skip
    if at_edge or last - first < 2:
        return without_parabola
    return _fit_vertex(xs[selection], ys[selection], deviations[selection]) or without_parabola


def _select_points(y: NDArray[np.float64], top: int) -> tuple[int, int]:
    """Return the first and last index of the points of the parabola around the highest point.

    They are above `UPPER_FRACTION` of it, or lower if fewer than `MIN_POINTS` are.
    """
    first = last = top
    limit = UPPER_FRACTION * y[top] if y[top] > 0.0 else y[top]
    while first > 0 and y[first - 1] >= limit:
        first -= 1
    while last < len(y) - 1 and y[last + 1] >= limit:
        last += 1
    while last - first + 1 < min(MIN_POINTS, len(y)):
        left = y[first - 1] if first > 0 else -math.inf
        right = y[last + 1] if last < len(y) - 1 else -math.inf
        first, last = (first - 1, last) if left >= right else (first, last + 1)
    return first, last


def _fit_vertex(
    x: NDArray[np.float64], y: NDArray[np.float64], deviation: NDArray[np.float64]
) -> Peak | None:
    """Return the vertex of the parabola; None if it is not a maximum among the points."""
    centre = float(x.mean())
    matrix = np.vander(x - centre, 3)
    degrees = len(x) - 3
    residuals = y - matrix @ np.linalg.lstsq(matrix, y, rcond=None)[0]
    measurement_variance = float(np.mean(deviation**2))
    misfit_variance = (
        max(0.0, float(residuals @ residuals) / degrees - measurement_variance) if degrees else 0.0
    )
    # Without this, a value that is nearly exact by chance would outweigh all others.
    variance = (
        np.maximum(deviation**2, measurement_variance)
        + misfit_variance
        + (1e-6 * float(np.abs(y).max())) ** 2
    )
    weighted = matrix / variance[:, None]
    covariance = np.linalg.inv(matrix.T @ weighted)
    a, b, c = coefficients = covariance @ (weighted.T @ y)
    if a >= 0.0 or not x[0] - centre <= -b / (2.0 * a) <= x[-1] - centre:
        return None
    offset = float(-b / (2.0 * a))
    slope = np.array([b / (2.0 * a**2), -1.0 / (2.0 * a), 0.0])
    powers = np.array([offset**2, offset, 1.0])
    quantile = student95(degrees) if degrees and misfit_variance > measurement_variance else Z95
    has_interval = degrees > 0 or measurement_variance > 0.0
    x_error = quantile * math.sqrt(slope @ covariance @ slope)
    return Peak(
        x=centre + offset,
        x_low=max(float(x[0]), centre + offset - x_error) if has_interval else None,
        x_high=min(float(x[-1]), centre + offset + x_error) if has_interval else None,
        y=float(powers @ coefficients),
        y_error=quantile * math.sqrt(powers @ covariance @ powers) if has_interval else None,
        at_edge=False,
        coefficients=(float(a), float(b), float(c)),
        centre=centre,
        span=(float(x[0]), float(x[-1])),
    )


def _to_array(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)
