"""Pictures of the tail from above, with motion blur, moving light and sensor noise.

The fish's axis runs along the rows of the picture, its head to the left; a fin angle α > 0 bends
the tail towards the higher rows. Each column of pixels crosses the tail in one strip.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.core.camera_frames import Pixels

PIVOT, LENGTH = 0.14, 0.74
"""Column of the tail's root and length of the tail, as fractions of the picture's width."""
ROOT_HALF_THICKNESS, TIP_HALF_THICKNESS = 0.055, 0.018
"""Half of the tail's thickness at its root and at its tip, as fractions of the width."""
WATER_LEVEL = 180.0
"""Grey level of the water."""
_POOL_SIZE = 4
"""Height and width of the pool of noise, in picture sizes."""
_RIPPLE_LENGTH = 0.1
"""Length of the caustics' ripples, as a fraction of the width."""
_PATTERN_VELOCITIES = ((0.31, 0.17), (-0.23, 0.29))
"""Velocities of the two patterns that add up to the caustics [widths/s]."""
_LIGHT_PERIOD = 23.0
"""Period of the slow drift of the light [s]."""

Array = NDArray[np.float32]


class TailPainter:
    """Painter of pictures, each with independent noise."""

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
        """Lateral shift of each column of the tail for tan α = 1 [px]."""
        self._half = (
            size * (ROOT_HALF_THICKNESS + (TIP_HALF_THICKNESS - ROOT_HALF_THICKNESS) * place)
        ).astype(np.float32)
        axis = (
            0.5 * (size - 1)
            + settings.off_axis
            + math.tan(settings.tilt) * (columns - 0.5 * (size - 1))
        )
        self._distance = (columns[:, None] - axis[None, :]).astype(np.float32)
        """Distance of each pixel from the axis, positive below it, shape (size, size) [px]."""
        self._still = self._background()
        self._noise = self._pool(settings.noise)
        self._caustics = [self._ripples() for _ in _PATTERN_VELOCITIES] if settings.caustics else []
        self._phase = float(self._random.uniform(0.0, math.tau))
        self._picture = np.empty((size, size), np.float32)

    def paint(self, alpha: float, alpha_rate: float, time: float) -> Pixels:
        """Return the picture at `time` [s] of a tail at α [rad] that moves with α̇ [rad/s]."""
        settings, size, picture = self._settings, self._size, self._picture
        np.copyto(picture, self._still)
        picture[:, self._tail] -= settings.contrast * self._coverage(alpha, alpha_rate)
        for pattern, (across, down) in zip(self._caustics, _PATTERN_VELOCITIES, strict=False):
            x, y = int(across * size * time) % size, int(down * size * time) % size
            picture += pattern[y : y + size, x : x + size]
        if settings.light_drift:
            swing = math.sin(math.tau * time / _LIGHT_PERIOD + self._phase)
            picture *= 1.0 + settings.light_drift * swing
        if settings.noise:
            y, x = self._random.integers(size * (_POOL_SIZE - 1), size=2).tolist()
            picture += self._noise[y : y + size, x : x + size]
        np.clip(picture, 0.0, 255.0, out=picture)
        return picture.astype(np.uint8)

    def _coverage(self, alpha: float, alpha_rate: float) -> Array:
        """Return the fraction of each pixel that the tail covers during the exposure.

        The tail's edge is a ramp, as wide as one pixel plus the motion during the exposure.
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
        """Return the picture of the water, the side light and the body, which does not move.

        It includes 0.5 grey levels, because levels are rounded down later.
        """
        settings, size = self._settings, self._size
        still = WATER_LEVEL + settings.side_light / size * self._distance + 0.5
        body = np.abs(self._distance[:, : self._tail.start]) < size * ROOT_HALF_THICKNESS
        still[:, : self._tail.start] -= settings.contrast * body
        return still.astype(np.float32)

    def _pool(self, deviation: float) -> Array:
        side = self._size * _POOL_SIZE
        return (deviation * self._random.standard_normal((side, side))).astype(np.float32)

    def _ripples(self) -> Array:
        """Return a smooth random pattern with a period of `size` pixels in both directions."""
        size = self._size
        waves = np.fft.fftfreq(
            size, 1.0 / (size * _RIPPLE_LENGTH)
        )  # relative to the frequency of a ripple
        square = waves[:, None] ** 2 + waves[None, :] ** 2
        spectrum = np.fft.fft2(self._random.standard_normal((size, size)))
        pattern = np.fft.ifft2(spectrum * square * np.exp(-square)).real
        pattern *= self._settings.caustics / math.sqrt(len(_PATTERN_VELOCITIES)) / pattern.std()
        return np.tile(pattern, (2, 2)).astype(np.float32)
