"""Makes the eye that a training asks for, and the babble that it is fitted to."""

from collections.abc import Iterator

import numpy as np

from fishd.learning.eyes.base import Eye
from fishd.learning.eyes.modes import ModesEye
from fishd.learning.eyes.pictures import CnnEye, NatureEye
from fishd.learning.settings import TrainingSettings


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


def babble(seed: int, ticks: int, amplitude: float) -> Iterator[float]:
    """Instruction angles that have nothing to do with what is seen [rad].

    ticks: how many
    amplitude: the largest [rad]
    """
    random = np.random.default_rng([seed, 1])
    angle = 0.0
    hold = 0
    for _ in range(ticks):
        if not hold:
            angle, hold = float(random.uniform(-amplitude, amplitude)), int(random.integers(1, 7))
        hold -= 1
        yield angle
