"""Axis of motion of the fish, estimated from pictures of a moving tail."""

import math
import random
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.core.camera_frames import Frame, Pixels
from fishd.core.errors import FishdError

Floats = NDArray[np.float64]

_MAX_TILT_RAD = 0.44
"""Largest tilt that is searched [rad]."""
_FIRST_STEPS = (0.5, 0.02)
"""Steps of offset and tilt in the first pass of the search [px, rad]."""
_MAX_OFFSET_FRACTION = 0.3
"""Largest distance of the axis from the middle row that is searched [picture heights]."""
_MIN_VARIANCE_RATIO = 1.5
"""Variance of a pixel, relative to the median pixel, above which the pixel moves."""
_MIN_LIKENESS = 0.45
"""Smallest likeness of the motion of a tail to its mirror image. A tail reaches 0.6 or more, even
one that lies across the rows; moving light reaches 0.26."""
_POINTS_PER_PIXEL = 8
"""Points per pixel to which the self-convolution of a column is interpolated."""
FRAME_SPAN_S = 20.0
"""Age of the oldest frame that the estimate uses [s]."""
FRAME_GAPS_S = (0.02, 0.08)
"""Range of the random minimum time between two kept frames [s]. With a fixed time, all kept frames
could show the same few phases of the beat."""
SEARCH_PERIOD_S = 3.0
"""Shortest time between two estimates, because one takes a tenth of a second [s]."""
_EMPTY_PICTURE = np.zeros((1, 1), np.uint8)
MIN_FRAMES = 40
"""Smallest number of frames for an estimate."""


class NoMotion(FishdError, ValueError):
    """The pictures show no tail that moves, so the axis cannot be estimated."""


class Axis(Struct, frozen=True, kw_only=True):
    """Straight line through the picture about which the tail swings symmetrically."""

    offset: float
    """Distance below the middle row at which the axis crosses the middle column [px]."""
    tilt: float = 0.0
    """Slope, positive where the axis goes down to the right [rad]."""

    def rows(self, height: int, width: int) -> Floats:
        """Return the row of the axis in each column, shape (width,) [px]."""
        columns = np.arange(width, dtype=np.float64) - 0.5 * (width - 1)
        rows: Floats = columns * math.tan(self.tilt) + (0.5 * (height - 1) + self.offset)
        return rows


class Motion(NamedTuple):
    """Motion in a set of pictures."""

    energy: Floats
    """Variance of each pixel above that of the median pixel, shape (height, width)."""
    axis: Axis
    centre: float
    """Column of the centre of the motion [px]."""
    is_certain: bool = True
    """False where the axis lies at the edge of the search range, and may lie outside it."""


def find_motion(pictures: NDArray[np.uint8]) -> Motion:
    """Return the motion and its axis in pictures of shape (number, height, width), ten or more.

    Changes of the overall brightness are removed. A tail that swings symmetrically leaves a picture
    of motion that equals its mirror image, so the axis is the line that maximises the convolution
    of each column with its mirror image, summed over the columns. Raises `NoMotion`.
    """
    if len(pictures) < 10:
        raise NoMotion(f"{len(pictures)} pictures are too few to see a motion in; 10 are needed")
    light = np.maximum(pictures.mean(axis=(1, 2)), 1.0)[:, None]
    # Row by row, because a row fits into the processor's cache.
    variance = np.stack(
        [(pictures[:, row] / light).var(axis=0) for row in range(pictures.shape[1])]
    )
    typical = float(np.median(variance))
    energy = np.where(variance > _MIN_VARIANCE_RATIO * typical, variance - typical, 0.0)
    if not np.count_nonzero(energy) >= 0.002 * energy.size:
        raise NoMotion(
            "nothing moves in these pictures but noise; let the fish swim, and see that the camera "
            "looks at its tail"
        )
    axis = find_axis(energy)
    if compute_likeness(energy, axis) < _MIN_LIKENESS:
        raise NoMotion(
            "what moves in these pictures is not a swinging tail, but perhaps light on the water; "
            "let the fish swim, and see that the camera looks at its tail"
        )
    centre = float(energy.sum(axis=0) @ np.arange(energy.shape[1]) / energy.sum())
    return Motion(energy, axis, centre, _is_inside(axis, len(energy)))


def compute_likeness(energy: Floats, axis: Axis) -> float:
    """Return how closely motion equals its mirror image about an axis, 0 to 1."""
    height, width = energy.shape
    rows = np.arange(height)[:, None]
    mirrored = np.rint(2.0 * axis.rows(height, width)[None, :] - rows).astype(int)
    inside = (mirrored >= 0) & (mirrored < height)
    columns = np.broadcast_to(np.arange(width), (height, width))
    image = np.where(inside, energy[np.clip(mirrored, 0, height - 1), columns], 0.0)
    return float((image * energy).sum() / (energy * energy).sum())


def find_axis(energy: Floats) -> Axis:
    """Return the axis of symmetry of a picture of motion, shape (height, width)."""
    height, width = energy.shape
    spectrum = np.fft.rfft(energy, 2 * height, axis=0).T
    convolutions = np.fft.irfft(spectrum**2, 2 * height * _POINTS_PER_PIXEL, axis=1)
    best, step = Axis(offset=0.0), _FIRST_STEPS
    offsets = np.arange(
        -_MAX_OFFSET_FRACTION * height, _MAX_OFFSET_FRACTION * height + 0.1, step[0]
    )
    tilts = np.arange(-_MAX_TILT_RAD, _MAX_TILT_RAD + 1e-9, step[1])
    for _ in range(3):
        sums = np.stack(
            [
                _sum_convolutions(
                    convolutions, Axis(offset=0.0, tilt=float(tilt)).rows(height, width), offsets
                )
                for tilt in tilts
            ],
            axis=1,
        )
        row, column = np.unravel_index(np.argmax(sums), sums.shape)
        best = Axis(offset=float(offsets[row]), tilt=float(tilts[column]))
        step = (step[0] / 5, step[1] / 5)
        offsets = best.offset + step[0] * np.arange(-5, 6)
        tilts = best.tilt + step[1] * np.arange(-5, 6)
    return best


def _sum_convolutions(convolutions: Floats, rows: Floats, offsets: Floats) -> Floats:
    """Return the sum over all columns of the self-convolution about a line, for each offset of it.

    rows: row of the line in each column [px]
    """
    twice = 2.0 * (rows[None, :] + offsets[:, None])
    points = np.clip(np.rint(twice * _POINTS_PER_PIXEL).astype(int), 0, convolutions.shape[1] - 1)
    sums: Floats = convolutions[np.arange(len(rows)), points].sum(axis=1)
    return sums


def _is_inside(axis: Axis, height: int) -> bool:
    """Return whether an axis lies inside the search range, away from its edges."""
    offset = _MAX_OFFSET_FRACTION * height - _FIRST_STEPS[0]
    tilt = _MAX_TILT_RAD - 0.5 * _FIRST_STEPS[1]
    return abs(axis.offset) < offset and abs(axis.tilt) < tilt


class AxisWatch:
    """Estimator of the axis; `add` takes every frame."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.axis: Axis | None = None
        """Latest axis; it stays valid while the fish rests, because the camera does not move."""
        self.moving = False
        """Whether there was motion in the latest search."""
        self._now = now
        self._frames: deque[tuple[float, Pixels]] = deque(
            maxlen=round(FRAME_SPAN_S / FRAME_GAPS_S[0])
        )
        self._random = random.Random(0)
        self._gap = 0.0
        self._next_search = now() + SEARCH_PERIOD_S

    def __len__(self) -> int:
        """Return the number of frames that the next search will use."""
        return len(self._frames)

    def add(self, frame: Frame) -> None:
        """Take a frame; reset on a frame of another size or with an earlier time."""
        if self._frames:
            latest_time, pixels = self._frames[-1]
            if pixels.shape != frame.pixels.shape or frame.time < latest_time:
                self._frames.clear()
                self.axis, self.moving = None, False
            elif frame.time - latest_time < self._gap:
                return
            self._gap = self._random.uniform(*FRAME_GAPS_S)
        self._frames.append((frame.time, frame.pixels))
        while frame.time - self._frames[0][0] > FRAME_SPAN_S:
            self._frames.popleft()

    @property
    def due(self) -> bool:
        """Whether it is time to search for the axis."""
        return len(self._frames) >= MIN_FRAMES and self._now() >= self._next_search

    def find(self) -> None:
        """Search for the axis; this takes a tenth of a second."""
        self._next_search = self._now() + SEARCH_PERIOD_S
        try:
            pictures = np.stack([pixels for _, pixels in self._frames or [(0.0, _EMPTY_PICTURE)]])
            self.axis = find_motion(pictures).axis
            self.moving = True
        except NoMotion:
            self.moving = False
