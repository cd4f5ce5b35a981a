"""Position of the tail in each picture, as one number that can be compared with forces."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import Floats, Motion, find_motion

_TAIL_THRESHOLD = 0.25
"""Difference from the median picture above which a pixel shows the tail, as a fraction of the 99 %
quantile of the differences."""
_MOTION_THRESHOLD = 0.05
"""Energy above which a pixel belongs to the motion, as a fraction of the largest energy."""


class Tails(NamedTuple):
    """Tail in a set of pictures."""

    positions: Floats
    """Deflection of the tail towards the higher rows, shape (number,) [px]."""
    motion: Motion


def find_tails(pictures: NDArray[np.uint8]) -> Tails:
    """Return the tail's position in pictures of shape (number, height, width), ten or more.

    The tail consists of the pixels that differ from the median picture, towards dark or light,
    whichever differs more. Its position is the mean distance of its pixels from the axis of motion.
    Raises `NoMotion`.
    """
    motion = find_motion(pictures)
    height, width = motion.energy.shape
    moving = motion.energy > _MOTION_THRESHOLD * motion.energy.max()
    rows, columns = np.nonzero(moving)
    values = pictures[:, rows, columns].astype(np.float32)
    light = pictures.mean(axis=(1, 2), dtype=np.float32)
    values *= (float(light.mean()) / np.maximum(light, 1.0))[:, None]
    values -= np.median(values, axis=0)
    if float(np.einsum("ij,ij,ij->", values, values, values, dtype=np.float64)) < 0.0:
        values = -values
    values -= _TAIL_THRESHOLD * float(np.quantile(values, 0.99))
    np.maximum(values, 0.0, out=values)
    distance = (rows - motion.axis.rows(height, width)[columns]).astype(np.float32)
    mass = values.sum(axis=1)
    return Tails((values @ distance / np.maximum(mass, 1e-6)).astype(np.float64), motion)
