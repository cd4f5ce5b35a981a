"""Where the tail is in each picture, as one number: what is measured against forces."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import Floats, Motion, find_motion

_SHARE = 0.25
"""A pixel shows the tail where it differs by more than this share of how far any differs."""
_REACH = 0.05
"""Motion is where its energy is more than this share of the largest."""


class Tails(NamedTuple):
    """The tail in a set of pictures."""

    positions: Floats
    """How far it is bent to the side of the higher rows, shape (number,) [px]."""
    motion: Motion


def find_tails(pictures: NDArray[np.uint8]) -> Tails:
    """The tail's position in pictures of shape (number, height, width), ten or more.

    The tail is what differs from the median picture, towards dark or light, whichever differs more.
    Its position is the mean distance of its pixels from the axis of motion. Raises `NoMotion`.
    """
    motion = find_motion(pictures)
    height, width = motion.energy.shape
    moving = motion.energy > _REACH * motion.energy.max()
    rows, columns = np.nonzero(moving)
    values = pictures[:, rows, columns].astype(np.float32)
    light = pictures.mean(axis=(1, 2), dtype=np.float32)
    values *= (float(light.mean()) / np.maximum(light, 1.0))[:, None]
    values -= np.median(values, axis=0)
    if float(np.einsum("ij,ij,ij->", values, values, values, dtype=np.float64)) < 0.0:
        values = -values
    values -= _SHARE * float(np.quantile(values, 0.99))
    np.maximum(values, 0.0, out=values)
    distance = (rows - motion.axis.rows(height, width)[columns]).astype(np.float32)
    mass = values.sum(axis=1)
    return Tails((values @ distance / np.maximum(mass, 1e-6)).astype(np.float64), motion)
