"""What a policy's network is given: what the eye makes of the pictures, then the features."""

import numpy as np
from numpy.typing import NDArray

from fishd.camera.frames import Stack
from fishd.controllers.policy.card import Feature, Layout
from fishd.core.signals import Observation
from fishd.learning.eyes.base import Eye


class Perception:
    """Turns an observation, and a stack of frames, into the network's input."""

    def __init__(self, features: tuple[Feature, ...], eye: Eye | None = None) -> None:
        self.features = features
        self.eye = eye
        self._layout = Layout(features)
        self._seen = eye.outputs if eye else 0
        self.inputs = self._seen + len(features)
        """How many numbers the network is given."""

    def vector(self, observation: Observation, stack: Stack | None = None) -> NDArray[np.float32]:
        """The input, shape (inputs,); stack: needed where there is an eye."""
        if self.eye is None:
            return self._layout.vector(observation)
        row = np.empty(self.inputs, np.float32)
        if stack is None or not self.eye.is_fitted:
            row[: self._seen] = 0.0
        else:
            row[: self._seen] = self.eye.see(stack)
        self._layout.write(observation, row[self._seen :])
        return row
