"""The eye of a training, and the babble that it is fitted to."""

import math

import numpy as np
from numpy.typing import NDArray

from fishd.learning.eyes.base import Eye
from fishd.learning.eyes.modes import ModesEye
from fishd.learning.eyes.pictures import CnnEye, NatureEye
from fishd.learning.settings import TrainingSettings

_MAX_HOLD_TICKS = 6
"""Largest number of ticks for which an angle of the babble is held."""


def make_eye(settings: TrainingSettings) -> Eye | None:
    """Return the eye of a training, not yet fitted; None where the agent sees only forces."""
    camera = settings.camera
    if settings.see == "force":
        return None
    if camera.eye == "modes":
        return ModesEye(camera.stack, camera.modes, camera.memory, camera.align)
    if camera.eye == "cnn":
        return CnnEye(camera.stack, camera.align)
    return NatureEye(camera.stack)


def random_angles(seed: int, ticks: int, amplitude: float) -> NDArray[np.float64]:
    """Return random instruction angles, independent of the pictures, shape (ticks,) [rad].

    The second half is the first one mirrored, so that the mean picture favours no side.

    ticks: number of angles
    amplitude: largest angle [rad]
    """
    random = np.random.default_rng([seed, 1])
    half = math.ceil(ticks / 2)
    levels = random.uniform(-amplitude, amplitude, half)
    angles = np.repeat(levels, random.integers(1, _MAX_HOLD_TICKS + 1, half))[:half]
    return np.concatenate((angles, -angles))[:ticks]
