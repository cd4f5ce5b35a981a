"""From which tail beat on a free swimmer's speed no longer changes, and so may be averaged."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Array = NDArray[np.float64]
LEAST_TIME = 8.0
"""The beats that are judged take as long at least: a fast wave has many in a moment [s]."""
STEADY, SCATTERING = 0.02, 0.05
"""The speed is steady where its two halves agree to the first share of it, or of a tenth of a
length a second; or to the second one, and within the 95 % interval of their difference."""


def judged_from(begins: Array, x: Array) -> int:
    """The number of the first beat that is judged.

    begins: when beats begin, and the last one ends, shape (beats + 1,) [s]
    x: where the fish is then, shape (beats + 1,) [m]

    So many beats are dropped that the standard error of the mean of the others is the smallest, but
    not more than half of them (the rule MSER of White, "An effective truncation heuristic for bias
    reduction in simulation output", Simulation 69, 1997, doi:10.1177/003754979706900601).
    """
    speeds = -np.diff(x) / np.diff(begins)
    count = len(speeds)
    errors = [speeds[first:].std() / math.sqrt(count - first) for first in range(count // 2 + 1)]
    return int(np.argmin(errors)) if errors else 0


def is_steady(begins: Array, x: Array, length: float) -> bool:
    """Whether the mean speeds over the two halves of these beats agree.

    begins, x: as for `judged_from`; length: of the fish [m]
    """
    count = len(begins) - 1
    if count < 2 or begins[-1] - begins[0] < LEAST_TIME:
        return False
    speeds = -np.diff(x) / np.diff(begins)
    halves = speeds[: count // 2], speeds[count - count // 2 :]
    apart = abs(float(halves[0].mean() - halves[1].mean()))
    scale = max(abs(float(speeds.mean())), 0.1 * length)
    allowed = STEADY * scale
    if count >= 4:
        variance = sum(half.var(ddof=1) / len(half) for half in halves)
        interval = float(stdtrit(count // 2 * 2 - 2, 0.975)) * math.sqrt(variance)
        allowed = max(allowed, min(interval, SCATTERING * scale))
    return apart <= allowed
