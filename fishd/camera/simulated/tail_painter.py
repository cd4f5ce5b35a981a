"""Draws the tail from above: blurred by its motion, under moving light, with a sensor's noise.

The fish's axis runs along the rows of the picture, its head to the left; a fin angle α > 0 bends
the tail towards the higher rows. Each column of pixels crosses the tail in one strip.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.core.camera_frames import Pixels

PIVOT, LENGTH = 0.14, 0.74
"""Where the tail begins, and its length, as shares of the picture's width."""
THICK, THIN = 0.055, 0.018
"""Half of the tail's thickness at its beginning and at its end, as shares of the width."""
WATER = 180.0
"""Grey level of the water."""
_POOL = 4
"""The pool of noise is so many times as high and as wide as a picture."""
_RIPPLE = 0.1
"""Length of the caustics' ripples, as a share of the width."""
_DRIFT = ((0.31, 0.17), (-0.23, 0.29))
"""Velocity of the two patterns whose sum the caustics are, in widths per second."""
_LIGHT_PERIOD = 23.0
"""Of the slow drift of the light [s]."""

Array = NDArray[np.float32]


class TailPainter:
    """Paints one picture after the other; each has noise of its own."""

    def __init__(self, settings: SimulatedCameraSettings, size: int) -> None:
        """size: height and width of a picture [px]"""
        self._settings = settings
        self._size = size
        self._random = np.random.default_rng(settings.seed)
        columns = np.arange(size, dtype=np.float32)
        along = np.clip((columns - PIVOT * size) / (LENGTH * size), 0.0, None)
        first, last = round(PIVOT * size), round((PIVOT + LENGTH) * size)
        self._tail = slice(first, last)
        place = along[self._tail]
        self._bend = (LENGTH * size * 0.5 * place * (1.0 + place)).astype(np.float32)
        """Lateral shift for tan α = 1, of each column of the tail [px]."""
        self._half = (size * (THICK + (THIN - THICK) * place)).astype(np.float32)
        axis = (
            0.5 * (size - 1)
            + settings.off_axis
            + math.tan(settings.tilt) * (columns - 0.5 * (size - 1))
        )
        self._distance = (columns[:, None] - axis[None, :]).astype(np.float32)
        """Of each pixel from the axis, positive below it, shape (size, size) [px]."""
        self._still = self._background()
        self._noise = self._pool(settings.noise)
        self._caustics = [self._ripples() for _ in _DRIFT] if settings.caustics else []
        self._phase = float(self._random.uniform(0.0, math.tau))
        self._picture = np.empty((size, size), np.float32)

    def paint(self, alpha: float, alpha_rate: float, time: float) -> Pixels:
        """The picture at `time` [s] of a tail at α [rad] that moves with α̇ [rad/s]."""
        settings, size, picture = self._settings, self._size, self._picture
        np.copyto(picture, self._still)
        picture[:, self._tail] -= settings.contrast * self._coverage(alpha, alpha_rate)
        for pattern, (across, down) in zip(self._caustics, _DRIFT, strict=False):
            x, y = int(across * size * time) % size, int(down * size * time) % size
            picture += pattern[y : y + size, x : x + size]
        if settings.light_drift:
            swing = math.sin(math.tau * time / _LIGHT_PERIOD + self._phase)
            picture *= 1.0 + settings.light_drift * swing
        if settings.noise:
            y, x = self._random.integers(size * (_POOL - 1), size=2).tolist()
            picture += self._noise[y : y + size, x : x + size]
        np.clip(picture, 0.0, 255.0, out=picture)
        return picture.astype(np.uint8)

    def _coverage(self, alpha: float, alpha_rate: float) -> Array:
        """Share of each pixel that the tail covers during the exposure.

        The tail's edge is a ramp as wide as one pixel and its motion together.
        """
        slope = math.tan(alpha)
        motion = alpha_rate * (1.0 + slope * slope) * self._settings.exposure
        sharp = 1.0 / np.sqrt(1.0 + (motion * self._bend) ** 2)
        off = (self._distance[:, self._tail] - slope * self._bend) * sharp
        half = self._half * sharp
        upper = np.clip(off + (half + 0.5), 0.0, 1.0)
        covered: Array = upper - np.clip(off - (half - 0.5), 0.0, 1.0)
        return covered

    def _background(self) -> Array:
        """Water, side light and the fish's body, which stands still; + 0.5, as levels are cut."""
        settings, size = self._settings, self._size
        still = WATER + settings.side_light / size * self._distance + 0.5
        body = np.abs(self._distance[:, : self._tail.start]) < size * THICK
        still[:, : self._tail.start] -= settings.contrast * body
        return still.astype(np.float32)

    def _pool(self, deviation: float) -> Array:
        side = self._size * _POOL
        return (deviation * self._random.standard_normal((side, side))).astype(np.float32)

    def _ripples(self) -> Array:
        """A smooth random pattern that repeats itself after `size` pixels both ways."""
        size = self._size
        waves = np.fft.fftfreq(size, 1.0 / (size * _RIPPLE))  # in units of a ripple's frequency
        square = waves[:, None] ** 2 + waves[None, :] ** 2
        spectrum = np.fft.fft2(self._random.standard_normal((size, size)))
        pattern = np.fft.ifft2(spectrum * square * np.exp(-square)).real
        pattern *= self._settings.caustics / math.sqrt(len(_DRIFT)) / pattern.std()
        return np.tile(pattern, (2, 2)).astype(np.float32)
