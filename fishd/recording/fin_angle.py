"""Fin angle at the ticks, interpolated between the pictures in which a camera has measured it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fishd.core.tail_reading import TailReading

MAX_GAP_S = 0.06
"""Longest time between two measured fin angles that is interpolated [s]."""

Array = NDArray[np.float64]


def interpolate(readings: Sequence[TailReading], times: ArrayLike) -> tuple[Array, Array]:
    """Return fin angle and uncertainty at times on the clock of the readings [rad].

    Both are NaN outside the readings, and across gaps of more than `MAX_GAP_S`. Between them the
    fin angle is a cubic spline: at 30 pictures a second and 2 Hz, a straight line would cut 9 mrad
    off a peak of 0.4 rad.
    """
    from scipy.interpolate import CubicSpline

    at = np.asarray(times, dtype=np.float64)
    angles, errors = np.full(at.shape, np.nan), np.full(at.shape, np.nan)
    rows = sorted((r.time, r.alpha, r.uncertainty or 0.0) for r in readings if r.alpha is not None)
    if not rows:
        return angles, errors
    table = np.array(rows)
    table = table[np.diff(table[:, 0], prepend=-np.inf) > 0.0]
    for part in np.split(table, np.flatnonzero(np.diff(table[:, 0]) > MAX_GAP_S) + 1):
        inside = (at >= part[0, 0]) & (at <= part[-1, 0])
        if len(part) > 1 and inside.any():
            angles[inside] = CubicSpline(part[:, 0], part[:, 1])(at[inside])
            errors[inside] = np.interp(at[inside], part[:, 0], part[:, 2])
    return angles, errors
