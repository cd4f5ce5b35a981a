"""What a policy's network is given: what the eye makes of the pictures, then the features."""

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.policy.card import ONE_TICK, Feature, History, Window
from fishd.core.camera_frames import Stack
from fishd.core.signals import Observation
from fishd.learning.eyes.base import Eye


class Perception:
    """Turns an observation, and a stack of frames, into the network's input."""

    def __init__(
        self,
        features: tuple[Feature, ...],
        eye: Eye | None = None,
        window: Window = ONE_TICK,
    ) -> None:
        """window: of which ticks the features are"""
        self.features = features
        self.eye = eye
        self.window = window
        self._history = History(features, window)
        self.numbers = len(self._history.row)
        """How many numbers the network is given beside what the eye gives."""
        self._seen = eye.outputs if eye else 0
        self.inputs = self._seen + self.numbers
        """How many it is given in all."""

    def anew(self) -> "Perception":
        """The same for another swim: with a history of its own."""
        return Perception(self.features, self.eye, self.window)

    def forget(self) -> None:
        """Another fish comes: begin the history anew."""
        self._history.forget()

    def note(self, observation: Observation) -> None:
        """Take a tick into the history, where there is one; `vector` does that, too."""
        if self.window.ticks > 1:
            self._history.push(observation)

    def vector(self, observation: Observation, stack: Stack | None = None) -> NDArray[np.float32]:
        """The input, shape (inputs,); stack: needed where there is an eye."""
        self._history.push(observation)
        if self.eye is None:
            return self._history.row.copy()
        row = np.empty(self.inputs, np.float32)
        if stack is None or not self.eye.is_fitted:
            row[: self._seen] = 0.0
        else:
            row[: self._seen] = self.eye.see(stack)
        row[self._seen :] = self._history.row
        return row
