"""Simulated camera: the frames that it takes while the tail moves from one tick to the next."""

import math
from typing import NamedTuple

import numpy as np

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.camera.simulated.tail_painter import TailPainter
from fishd.core.camera_frames import TIME_TOLERANCE_S, Frame


class Tail(NamedTuple):
    """Position and velocity of the tail."""

    time: float
    """Time [s]."""
    alpha: float
    """Fin angle [rad]."""
    alpha_rate: float
    """Angular velocity of the fin [rad/s]."""


class SimulatedCamera:
    """Camera that takes its frames from the fin angle over time."""

    def __init__(self, settings: SimulatedCameraSettings, size: int) -> None:
        """size: height and width of a frame [px]"""
        self._settings = settings
        self._painter = TailPainter(settings, size)
        self._random = np.random.default_rng([settings.seed, 1])
        self._phase = float(self._random.uniform())
        """Phase of the frames relative to time zero, in periods."""
        self._available = -math.inf

    def frames(self, before: Tail, after: Tail) -> list[Frame]:
        """Return the frames exposed after `before` and up to `after`.

        Between the two, the fin angle is the cubic polynomial through their angles and rates.
        """
        frames = []
        for time in self._times(before.time, after.time):
            alpha, alpha_rate = _interpolate(before, after, time)
            pixels = self._painter.paint(alpha, alpha_rate, time)
            latency = self._settings.latency
            if self._settings.jitter:
                latency += float(self._random.normal(0.0, self._settings.jitter))
            self._available = max(self._available, time + max(0.0, latency))
            frames.append(Frame(time, self._available, pixels))
        return frames

    def _times(self, begin: float, end: float) -> list[float]:
        rate = self._settings.rate
        if rate is None:  # frames are available when a tick begins
            tick = end - begin
            ticks = math.floor((self._settings.latency + TIME_TOLERANCE_S) / tick)
            return [end - max(0.0, self._settings.latency - ticks * tick)]
        first = math.floor(begin * rate - self._phase) + 1
        last = math.floor(end * rate - self._phase)
        return [(number + self._phase) / rate for number in range(first, last + 1)]


def _interpolate(before: Tail, after: Tail, time: float) -> tuple[float, float]:
    """Return angle and rate on the cubic Hermite polynomial through both ends."""
    h = after.time - before.time
    s = (time - before.time) / h
    left, right = before.alpha_rate * h, after.alpha_rate * h
    rise = after.alpha - before.alpha
    square = 3.0 * rise - 2.0 * left - right
    cube = left + right - 2.0 * rise
    alpha = before.alpha + s * (left + s * (square + s * cube))
    return alpha, (left + s * (2.0 * square + 3.0 * s * cube)) / h
