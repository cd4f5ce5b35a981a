"""Maximal fin angle of each beat, from readings at the times of pictures."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_HYSTERESIS = 0.15
"""Distance from the middle at which a half beat begins, relative to half of the swing."""
_MAX_GAP = 1.6
"""Longest time between readings around a reversal, relative to the usual one."""
_NEAR = 0.1
"""Time around a reversal in which readings belong to its parabola, relative to the beat."""
MIN_SWING_RAD = 0.005
"""Smallest swing that has beats [rad]."""
_T95 = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23)
"""Two-sided 95 % quantiles of Student's t with 1 to 10 degrees of freedom."""


class Beat(NamedTuple):
    """One whole beat."""

    time: float
    """Time of the reversal on the positive side [s]."""
    alpha_max: float
    """Half of the swing from peak to peak [rad]."""
    middle: float
    """Middle of the swing [rad]."""
    back: float = 0.0
    """Time of the reversal on the negative side, which follows [s]."""


def find_maxima(time: Sequence[float], alpha: Iterable[float | None]) -> list[Beat]:
    """Return the whole beats whose reversals are seen.

    Each reversal is the vertex of a parabola through the readings near it, three or more. A beat
    with an unknown angle near a reversal is left out.

    time: increasing times of pictures [s]
    alpha: their fin angles, None where it is unknown [rad]
    """
    angles = np.array([math.nan if value is None else value for value in alpha], np.float64)
    known = np.isfinite(angles)
    times, angles = np.asarray(time, np.float64)[known], angles[known]
    if len(times) < 8:
        return []
    low, high = np.quantile(angles, [0.05, 0.95])
    if high - low < MIN_SWING_RAD:
        return []
    usual = float(np.median(np.diff(np.asarray(time, np.float64))))
    bounds = _find_crossings(angles, 0.5 * (low + high), 0.5 * _HYSTERESIS * (high - low))
    beats = []
    for begin, turn, end in zip(bounds[:-2:2], bounds[1:-1:2], bounds[2::2], strict=True):
        period = times[end] - times[begin]
        top = _find_vertex(times, angles, slice(begin, turn), period, usual)
        bottom = _find_vertex(times, -angles, slice(turn, end), period, usual)
        if top is not None and bottom is not None:
            swing, middle = top[1] + bottom[1], top[1] - bottom[1]
            beats.append(Beat(top[0], 0.5 * swing, 0.5 * middle, bottom[0]))
    return beats


def average(beats: Sequence[Beat]) -> tuple[float, float] | None:
    """Return the mean of `alpha_max` and the half-width of its 95 % interval [rad].

    None for fewer than two beats.
    """
    if len(beats) < 2:
        return None
    values = np.array([beat.alpha_max for beat in beats])
    quantile = _T95[len(values) - 2] if len(values) <= len(_T95) + 1 else 2.0
    spread = float(values.std(ddof=1)) / math.sqrt(len(values))
    return float(values.mean()), quantile * spread


def _find_crossings(angles: Array, middle: float, hysteresis: float) -> list[int]:
    """Return the first reading of each half beat, beginning with a positive one."""
    crossings: list[int] = []
    side = 0
    for index, angle in enumerate(angles):
        now = 1 if angle > middle + hysteresis else -1 if angle < middle - hysteresis else side
        if now != side and side and (crossings or now > 0):
            crossings.append(index)
        side = now
    return crossings if len(crossings) % 2 else crossings[:-1]


def _find_vertex(
    times: Array, angles: Array, part: slice, period: float, usual: float
) -> tuple[float, float] | None:
    """Return time and height of the maximum; None where readings near it are missing."""
    top = part.start + int(angles[part].argmax())
    first, last = top - 1, top + 1
    while first > 0 and times[top] - times[first - 1] <= _NEAR * period:
        first -= 1
    while last + 1 < len(times) and times[last + 1] - times[top] <= _NEAR * period:
        last += 1
    if first < 0 or last >= len(times) or np.diff(times[first : last + 1]).max() > _MAX_GAP * usual:
        return None
    offset = times[first : last + 1] - times[top]
    c, b, a = np.polynomial.polynomial.polyfit(offset, angles[first : last + 1], 2)
    if a >= 0.0:
        return None
    place = min(max(-0.5 * b / a, offset[0]), offset[-1])
    return float(times[top] + place), float(c + b * place + a * place**2)
