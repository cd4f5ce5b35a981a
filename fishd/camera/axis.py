"""The fish's axis of motion, found from pictures of a tail that moves."""

import math
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.core.errors import FishdError

Floats = NDArray[np.float64]

_STEEPEST = 0.44
"""Largest tilt that is looked for [rad]."""
_FIRST = (0.5, 0.02)
"""Steps of offset and tilt at first [px, rad]."""
_SHARE = 0.3
"""The axis lies within this share of the height about the middle row."""
_MOTION = 1.5
"""A pixel that moves with the tail varies more than so many times as much as a typical one."""
_LIKENESS = 0.45
"""Of motion to its own mirror image: of a tail 0.6 or more, even across the rows; of light 0.26."""
_FINE = 8
"""The self-convolution of a column is interpolated to so many points per pixel."""


class NoMotion(FishdError, ValueError):
    """Nothing moves in the pictures that the axis is to be found in."""


class Axis(Struct, frozen=True, kw_only=True):
    """A straight line through the picture about which the tail swings evenly."""

    offset: float
    """How far below the middle row it crosses the middle column [px]."""
    tilt: float = 0.0
    """Its slope, positive where it goes down to the right [rad]."""

    def rows(self, height: int, width: int) -> Floats:
        """Its row in each column, shape (width,) [px]."""
        columns = np.arange(width, dtype=np.float64) - 0.5 * (width - 1)
        found: Floats = columns * math.tan(self.tilt) + (0.5 * (height - 1) + self.offset)
        return found


class Motion(NamedTuple):
    """What moves in a set of pictures."""

    energy: Floats
    """Variance of each pixel beyond that of a typical one, shape (height, width)."""
    axis: Axis
    centre: float
    """Column about which the motion is centred [px]."""
    sure: bool = True
    """False where the axis lies at the edge of what was looked at, so that it may lie beyond."""


def find_motion(pictures: NDArray[np.uint8]) -> Motion:
    """The motion and its axis, in pictures of shape (number, height, width), ten or more.

    Light that changes as a whole is taken off. A tail that swings evenly leaves a picture of motion
    that is its own mirror image: the axis is where that, convolved with its mirror image in each
    column, adds up to most. Raises `NoMotion`.
    """
    if len(pictures) < 10:
        raise NoMotion(f"{len(pictures)} pictures are too few to see a motion in; 10 are needed")
    light = np.maximum(pictures.mean(axis=(1, 2)), 1.0)[:, None]
    # Row by row, which the processor's cache holds.
    variance = np.stack(
        [(pictures[:, row] / light).var(axis=0) for row in range(pictures.shape[1])]
    )
    typical = float(np.median(variance))
    energy = np.where(variance > _MOTION * typical, variance - typical, 0.0)
    if not np.count_nonzero(energy) >= 0.002 * energy.size:
        raise NoMotion(
            "nothing moves in these pictures but noise; let the fish swim, and see that the camera "
            "looks at its tail"
        )
    axis = find_axis(energy)
    if likeness(energy, axis) < _LIKENESS:
        raise NoMotion(
            "what moves in these pictures is no tail that swings, but light on the water perhaps; "
            "let the fish swim, and see that the camera looks at its tail"
        )
    centre = float(energy.sum(axis=0) @ np.arange(energy.shape[1]) / energy.sum())
    return Motion(energy, axis, centre, _is_inside(axis, len(energy)))


def likeness(energy: Floats, axis: Axis) -> float:
    """How much motion is its own mirror image about an axis: 0 to 1."""
    height, width = energy.shape
    rows = np.arange(height)[:, None]
    mirrored = np.rint(2.0 * axis.rows(height, width)[None, :] - rows).astype(int)
    inside = (mirrored >= 0) & (mirrored < height)
    columns = np.broadcast_to(np.arange(width), (height, width))
    image = np.where(inside, energy[np.clip(mirrored, 0, height - 1), columns], 0.0)
    return float((image * energy).sum() / (energy * energy).sum())


def find_axis(energy: Floats) -> Axis:
    """The line about which a picture of motion, shape (height, width), is its own mirror image."""
    height, width = energy.shape
    spectrum = np.fft.rfft(energy, 2 * height, axis=0).T
    folded = np.fft.irfft(spectrum**2, 2 * height * _FINE, axis=1)
    best, step = Axis(offset=0.0), _FIRST
    offsets = np.arange(-_SHARE * height, _SHARE * height + 0.1, step[0])
    tilts = np.arange(-_STEEPEST, _STEEPEST + 1e-9, step[1])
    for _ in range(3):
        sums = np.stack(
            [
                _folded_at(folded, Axis(offset=0.0, tilt=float(tilt)).rows(height, width), offsets)
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


def _folded_at(folded: Floats, rows: Floats, offsets: Floats) -> Floats:
    """Sums over all columns of the self-convolution about a line that is moved by each offset.

    rows: of the line, in each column [px]
    """
    twice = 2.0 * (rows[None, :] + offsets[:, None])
    points = np.clip(np.rint(twice * _FINE).astype(int), 0, folded.shape[1] - 1)
    sums: Floats = folded[np.arange(len(rows)), points].sum(axis=1)
    return sums


def _is_inside(axis: Axis, height: int) -> bool:
    """Is it clear of the edges of what was looked at?"""
    offset, tilt = _SHARE * height - _FIRST[0], _STEEPEST - 0.5 * _FIRST[1]
    return abs(axis.offset) < offset and abs(axis.tilt) < tilt
