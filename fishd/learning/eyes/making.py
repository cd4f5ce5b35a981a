"""Makes the eye that a training asks for, and the babble that it is fitted to."""

import math

import numpy as np
from numpy.typing import NDArray

from fishd.learning.eyes.base import Eye
from fishd.learning.eyes.modes import ModesEye
from fishd.learning.eyes.pictures import CnnEye, NatureEye
from fishd.learning.settings import TrainingSettings

_LONGEST = 6
"""An angle of the babble is held for up to so many ticks."""


def make(settings: TrainingSettings) -> Eye | None:
    """The eye of a training, not yet fitted; None where only forces are seen."""
    camera = settings.camera
    if settings.see == "force":
        return None
    if camera.eye == "modes":
        return ModesEye(camera.stack, camera.modes, camera.memory, camera.align)
    if camera.eye == "cnn":
        return CnnEye(camera.stack, camera.align)
    return NatureEye(camera.stack)


def babble(seed: int, ticks: int, amplitude: float) -> NDArray[np.float64]:
    """Instruction angles that have nothing to do with what is seen, shape (ticks,) [rad].

    The second half is the first one mirrored, so that the mean picture favours no side.

    ticks: how many
    amplitude: the largest [rad]
    """
    random = np.random.default_rng([seed, 1])
    half = math.ceil(ticks / 2)
    levels = random.uniform(-amplitude, amplitude, half)
    angles = np.repeat(levels, random.integers(1, _LONGEST + 1, half))[:half]
    return np.concatenate((angles, -angles))[:ticks]
