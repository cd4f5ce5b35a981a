"""Picture without the tail, and the fraction of each place that the tail covers."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from fishd.core.camera_frames import Pixels

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

SMALL_WIDTH_PX = 180
"""Largest width of the small picture in which the tail is searched [px]."""
_MIN_CONTRAST = 0.4
"""Smallest contrast of a place that can show the tail, relative to the typical one."""
_MAX_LIGHT_CHANGE = 0.35
"""Largest difference of the light of a row from that of the picture, relative."""
_MIN_STILL_PIXELS = 6
"""Fewest pixels of a row that show its light."""


def shrink(picture: Pixels, largest_width: int = SMALL_WIDTH_PX) -> Pixels:
    """Return the picture averaged over squares of pixels, not wider than this [px]."""
    factor = math.ceil(picture.shape[1] / largest_width)
    if factor == 1:
        return picture
    size = (round(picture.shape[1] / factor), round(picture.shape[0] / factor))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def to_levels(picture: Floats) -> Pixels:
    """Return the nearest grey levels."""
    return np.asarray(np.clip(picture + 0.5, 0.0, 255.0), np.float32).astype(np.uint8)


class Ground:
    """Picture without the tail; `cover` is 1 where the tail is and 0 where the ground is."""

    def __init__(
        self, background: Pixels, size: tuple[int, int], tail_level: float, swept: Mask
    ) -> None:
        """
        background: picture without the tail, of any resolution
        size: width and height of the pictures to measure [px]
        tail_level: grey level of the tail in the light of the background
        swept: where the tail can be, of any resolution
        """
        self.size = size
        whole = cv2.resize(background, size, interpolation=cv2.INTER_LINEAR)
        self._whole = np.asarray(whole, np.uint8)
        self._tail_level = np.float32(tail_level)
        self.background = np.asarray(shrink(self._whole), np.float32)
        height, width = self.background.shape
        self.scale = size[0] / width
        """Pixels of the picture for one of the small picture."""
        small = cv2.resize(swept.astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA)
        self.still = np.asarray(small) == 0
        difference = self._tail_level - self.background
        self.contrast = float(np.median(np.abs(difference[~self.still])))
        self._least = np.float32(_MIN_CONTRAST * self.contrast)
        self._sign = np.float32(np.sign(np.median(difference[~self.still])))
        self._contrast = self._limited(difference)
        self._still_count = self.still.sum(axis=1)
        self._rows = np.arange(height, dtype=np.float32)

    def light(self, small: Pixels) -> Floats:
        """Return the light of each row of a small picture, relative to that of the background."""
        ratio = np.asarray(small / np.maximum(self.background, 1.0), np.float32)
        typical = float(np.median(ratio[self.still][::3]))
        low, high = typical * (1.0 - _MAX_LIGHT_CHANGE), typical * (1.0 + _MAX_LIGHT_CHANGE)
        ratio = np.asarray(np.clip(ratio, low, high) * self.still, np.float32)
        known = self._still_count >= _MIN_STILL_PIXELS
        light = ratio.sum(axis=1)[known] / self._still_count[known]
        rows = np.interp(self._rows, self._rows[known], light).astype(np.float32)
        return np.asarray(cv2.blur(rows[:, None], (1, 5)), np.float32)[:, 0]

    def cover(self, small: Pixels, light: Floats) -> Floats:
        """Return the fraction of each pixel of a small picture that the tail covers."""
        even = small / light[:, None]
        return np.asarray((even - self.background) / self._contrast, np.float32)

    def sample(self, picture: Pixels, light: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Return the fraction that the tail covers and the grey level at points of a picture.

        light: of each row of the small picture
        points: columns and rows, shape (m, n, 2) [px]
        """
        x, y = np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1])
        seen, empty = (
            np.asarray(
                cv2.remap(each, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
            )
            for each in (picture, self._whole)
        )
        row = np.clip(((y + 0.5) / self.scale).astype(np.int32), 0, len(light) - 1)
        return (seen / light[row] - empty) / self._limited(self._tail_level - empty), seen

    def _limited(self, difference: Floats) -> Floats:
        return np.asarray(self._sign * np.maximum(self._sign * difference, self._least), np.float32)
