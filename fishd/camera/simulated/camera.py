"""A simulated camera: which frames it takes while the tail moves from one tick to the next."""

import math
from typing import NamedTuple

import numpy as np

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.camera.simulated.tail_painter import TailPainter
from fishd.core.camera_frames import EQUAL, Frame


class Tail(NamedTuple):
    """Where the tail is, and how fast it moves."""

    time: float
    """[s]"""
    alpha: float
    """Fin angle [rad]."""
    alpha_rate: float
    """[rad/s]"""


class SimulatedCamera:
    """Takes its frames from the course of the fin angle."""

    def __init__(self, settings: SimulatedCameraSettings, size: int) -> None:
        """size: height and width of a frame [px]"""
        self._settings = settings
        self._painter = TailPainter(settings, size)
        self._random = np.random.default_rng([settings.seed, 1])
        self._phase = float(self._random.uniform())
        """Of the frames against time zero, in periods."""
        self._available = -math.inf

    def frames(self, before: Tail, after: Tail) -> list[Frame]:
        """The frames exposed after `before` and up to `after`, at their times of arrival.

        Between the two the fin angle is the cubic that has their angles and rates.
        """
        found = []
        for time in self._times(before.time, after.time):
            alpha, alpha_rate = _between(before, after, time)
            pixels = self._painter.paint(alpha, alpha_rate, time)
            late = self._settings.latency
            if self._settings.jitter:
                late += float(self._random.normal(0.0, self._settings.jitter))
            self._available = max(self._available, time + max(0.0, late))
            found.append(Frame(time, self._available, pixels))
        return found

    def _times(self, begin: float, end: float) -> list[float]:
        rate = self._settings.rate
        if rate is None:  # there when a tick begins
            tick = end - begin
            ticks = math.floor((self._settings.latency + EQUAL) / tick)
            return [end - max(0.0, self._settings.latency - ticks * tick)]
        first = math.floor(begin * rate - self._phase) + 1
        last = math.floor(end * rate - self._phase)
        return [(number + self._phase) / rate for number in range(first, last + 1)]


def _between(before: Tail, after: Tail, time: float) -> tuple[float, float]:
    """Angle and rate on the cubic Hermite polynomial through both ends."""
    h = after.time - before.time
    s = (time - before.time) / h
    left, right = before.alpha_rate * h, after.alpha_rate * h
    rise = after.alpha - before.alpha
    square = 3.0 * rise - 2.0 * left - right
    cube = left + right - 2.0 * rise
    alpha = before.alpha + s * (left + s * (square + s * cube))
    return alpha, (left + s * (2.0 * square + 3.0 * s * cube)) / h
