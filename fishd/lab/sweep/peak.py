"""Where a measured curve has its maximum, with an interval: a parabola through its upper part."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fishd.lab.statistics import Z95, student95

UPPER = 0.85
"""The parabola goes through what is above this share of the highest value, around it."""
FEWEST = 5
"""It goes through as many points where there are so many; three at least."""


class Peak(NamedTuple):
    """The maximum of a curve y(x), in the units of x and y."""

    x: float
    x_low: float | None
    """The 95 % interval of `x`; None if the points do not tell it."""
    x_high: float | None
    y: float
    y_error: float | None
    """Half of the 95 % interval of `y`."""
    at_edge: bool
    """The highest value is the first or the last: `x` is that, and the maximum may lie beyond."""
    coefficients: tuple[float, float, float] | None
    """Of the parabola a·(x − x₀)² + b·(x − x₀) + c, x₀ = `centre`; None without one."""
    centre: float
    span: tuple[float, float]
    """What the parabola was fitted to, in x."""


def peak(x: Sequence[float], y: Sequence[float], error: Sequence[float | None]) -> Peak:
    """The maximum of y over x.

    error: half of the 95 % interval of each y; None where it is not known

    The interval is that of the vertex of a weighted least-squares parabola. A value varies by its
    own error and by what the curve differs from a parabola, which is taken from the residuals.
    Raises ValueError without any point.
    """
    order = np.argsort(x)
    xs, ys = _array(x)[order], _array(y)[order]
    deviations = np.array([(each or 0.0) / Z95 for each in error])[order]
    if not len(xs):
        raise ValueError("a curve without points has no maximum")
    top = int(np.argmax(ys))
    first, last = _around(ys, top)
    shown = slice(first, last + 1)
    highest = error[int(order[top])]
    at_edge = top in (0, len(xs) - 1)
    only = Peak(
        float(xs[top]), None, None, float(ys[top]), highest, at_edge, None, float(xs[top]),
        (float(xs[first]), float(xs[last])),
    )  # fmt: skip
    if at_edge or last - first < 2:
        return only
    return _vertex(xs[shown], ys[shown], deviations[shown]) or only


def _around(y: NDArray[np.float64], top: int) -> tuple[int, int]:
    """The points around the highest that are above `UPPER` of it, and more where those are few."""
    first = last = top
    limit = UPPER * y[top] if y[top] > 0.0 else y[top]
    while first > 0 and y[first - 1] >= limit:
        first -= 1
    while last < len(y) - 1 and y[last + 1] >= limit:
        last += 1
    while last - first + 1 < min(FEWEST, len(y)):
        left = y[first - 1] if first > 0 else -math.inf
        right = y[last + 1] if last < len(y) - 1 else -math.inf
        first, last = (first - 1, last) if left >= right else (first, last + 1)
    return first, last


def _vertex(
    x: NDArray[np.float64], y: NDArray[np.float64], deviation: NDArray[np.float64]
) -> Peak | None:
    """None where the parabola has no maximum among the points."""
    centre = float(x.mean())
    matrix = np.vander(x - centre, 3)
    degrees = len(x) - 3
    residuals = y - matrix @ np.linalg.lstsq(matrix, y, rcond=None)[0]
    own = float(np.mean(deviation**2))
    lack = max(0.0, float(residuals @ residuals) / degrees - own) if degrees else 0.0
    # A value that is nearly exact by chance does not outweigh all others.
    variance = np.maximum(deviation**2, own) + lack + (1e-6 * float(np.abs(y).max())) ** 2
    weighted = matrix / variance[:, None]
    covariance = np.linalg.inv(matrix.T @ weighted)
    a, b, c = coefficients = covariance @ (weighted.T @ y)
    if a >= 0.0 or not x[0] - centre <= -b / (2.0 * a) <= x[-1] - centre:
        return None
    at = float(-b / (2.0 * a))
    slope = np.array([b / (2.0 * a**2), -1.0 / (2.0 * a), 0.0])
    here = np.array([at**2, at, 1.0])
    width = student95(degrees) if degrees and lack > own else Z95
    known = degrees > 0 or own > 0.0
    x_error = width * math.sqrt(slope @ covariance @ slope)
    return Peak(
        x=centre + at,
        x_low=max(float(x[0]), centre + at - x_error) if known else None,
        x_high=min(float(x[-1]), centre + at + x_error) if known else None,
        y=float(here @ coefficients),
        y_error=width * math.sqrt(here @ covariance @ here) if known else None,
        at_edge=False,
        coefficients=(float(a), float(b), float(c)),
        centre=centre,
        span=(float(x[0]), float(x[-1])),
    )


def _array(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, dtype=np.float64)
