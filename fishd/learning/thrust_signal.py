"""Removal of the errors of a force sensor from the thrust, before a policy learns from it.

F_x of a real rig has an offset that drifts, spikes, and, where the sensor is turned, a share of F_y
that is larger than the thrust. A policy does not cause any of these. The remaining signal differs
from tick to tick as the true thrust does; only its mean is lost, which does not affect advantages.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

MEMORY_TICKS = 4096
"""Number of latest ticks from which the share of F_y is estimated."""
ORDINARY_THRUSTS = 3.0
"""Largest ordinary distance of a tick's thrust from the median, in best mean thrusts; square waves
of simulated fish reach two."""
ORDINARY_DEVIATIONS = 4.5
"""Distance from the median below which a thrust is ordinary, too, in medians of the distance."""
_PASSES = 4
_HUBER_MEDIANS = 1.5

Forces = NDArray[np.float64]


class ThrustSignal:
    """An estimator of thrust that keeps the latest forces, to find how the sensor is turned."""

    def __init__(self, best: float) -> None:
        """best: mean thrust of the best square wave [N]"""
        self._ordinary = ORDINARY_THRUSTS * best
        self._past: deque[tuple[float, float]] = deque(maxlen=MEMORY_TICKS)

    def estimate(self, fx: Forces, fy: Forces) -> Forces:
        """Return the thrust of each tick of a rollout, up to a constant [N], shape (ticks,).

        fx, fy: mean measured forces of each tick [N], shape (ticks,)

        Left and right are symmetric, so over many beats the true F_x does not correlate with F_y:
        a correlation of the measured F_x is the share of F_y in it.
        """
        if not len(fx):
            return fx
        self._past.extend(zip(fx.tolist(), fy.tolist(), strict=True))
        thrust = fx - slope(*np.array(self._past).T) * (fy - fy.mean())
        deviations = thrust - np.median(thrust)
        limit = max(self._ordinary, ORDINARY_DEVIATIONS * float(np.median(np.abs(deviations))))
        ordinary: Forces = np.where(np.abs(deviations) < limit, deviations, 0.0)
        return ordinary - float(ordinary.mean())


def slope(fx: Forces, fy: Forces) -> float:
    """Return the slope of the line through the points (fy, fx), robust to outliers (Huber)."""
    x, y = fy - np.median(fy), fx - np.median(fx)
    weights, coefficient = np.ones_like(x), 0.0
    for _ in range(_PASSES):
        squares = float(weights @ (x * x))
        if squares <= 0.0:
            return 0.0
        coefficient = float(weights @ (x * y)) / squares
        deviations = np.abs(y - coefficient * x)
        spread = _HUBER_MEDIANS * float(np.median(deviations))
        weights = np.minimum(1.0, spread / np.maximum(deviations, 1e-30)) if spread else weights
    return coefficient
