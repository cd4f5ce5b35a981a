"""What a force sensor adds to the thrust, taken off before a policy learns from it.

F_x of a real rig has an offset that drifts, spikes, and, where the sensor is turned, a share of F_y
that is larger than the thrust. None of it is anything that a policy did. What remains differs from
tick to tick as the true thrust does; only how large it is on the whole is lost, by which advantages
do not differ.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

MEMORY = 4096
"""Ticks by which the share of F_y is found."""
ORDINARY = 3.0
"""The thrust of a tick is within so many times the best mean thrust of the median; square waves of
simulated fish get to two."""
OUTLIER = 4.5
"""And so is what differs by less than so many medians of the difference."""
_PASSES = 4
_HUBER = 1.5


Forces = NDArray[np.float64]


class ThrustSignal:
    """Remembers the latest forces, by which it knows how the sensor is turned."""

    def __init__(self, best: float) -> None:
        """best: mean thrust of the best square wave [N]"""
        self._ordinary = ORDINARY * best
        self._past: deque[tuple[float, float]] = deque(maxlen=MEMORY)

    def of(self, fx: Forces, fy: Forces) -> Forces:
        """The thrust of each tick of a rollout, up to a constant [N], shape (ticks,).

        fx, fy: mean measured forces of each [N], shape (ticks,)

        Left and right are alike, so over many beats the true F_x goes with F_y in no way: where the
        measured one does, that is the share of F_y in it.
        """
        if not len(fx):
            return fx
        self._past.extend(zip(fx.tolist(), fy.tolist(), strict=True))
        thrust = fx - slope(*np.array(self._past).T) * (fy - fy.mean())
        off = thrust - np.median(thrust)
        most = max(self._ordinary, OUTLIER * float(np.median(np.abs(off))))
        ordinary: Forces = np.where(np.abs(off) < most, off, 0.0)
        return ordinary - float(ordinary.mean())


def slope(fx: Forces, fy: Forces) -> float:
    """Of the straight line through the points (fy, fx), which outliers hardly move (Huber)."""
    x, y = fy - np.median(fy), fx - np.median(fx)
    weights, found = np.ones_like(x), 0.0
    for _ in range(_PASSES):
        squares = float(weights @ (x * x))
        if squares <= 0.0:
            return 0.0
        found = float(weights @ (x * y)) / squares
        off = np.abs(y - found * x)
        spread = _HUBER * float(np.median(off))
        weights = np.minimum(1.0, spread / np.maximum(off, 1e-30)) if spread else weights
    return found
