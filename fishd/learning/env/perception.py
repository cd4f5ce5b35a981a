"""The inputs of the network of a policy: the outputs of the eye, then the features."""

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.policy.card import ONE_TICK, Feature, History, Window
from fishd.core.camera_frames import Stack
from fishd.core.signals import Observation
from fishd.learning.eyes import Eye


class Perception:
    """A conversion of observations, and stacks of frames, to inputs of a network."""

    def __init__(
        self,
        features: tuple[Feature, ...],
        eye: Eye | None = None,
        window: Window = ONE_TICK,
    ) -> None:
        """window: ticks that the features are from"""
        self.features = features
        self.eye = eye
        self.window = window
        self._history = History(features, window)
        self.numbers = len(self._history.row)
        """Number of inputs beside the outputs of the eye."""
        self._eye_outputs = eye.outputs if eye else 0
        self.inputs = self._eye_outputs + self.numbers
        """Number of all inputs."""

    def with_new_history(self) -> "Perception":
        """Return the same perception for another swim, with an empty history."""
        return Perception(self.features, self.eye, self.window)

    def forget(self) -> None:
        """Empty the history, since another fish follows."""
        self._history.forget()

    def note(self, observation: Observation) -> None:
        """Add a tick to the history, if there is one; `vector` does that, too."""
        if self.window.ticks > 1:
            self._history.push(observation)

    def vector(self, observation: Observation, stack: Stack | None = None) -> NDArray[np.float32]:
        """Return the inputs, shape (inputs,); stack: needed if there is an eye."""
        self._history.push(observation)
        if self.eye is None:
            return self._history.row.copy()
        row = np.empty(self.inputs, np.float32)
        if stack is None or not self.eye.is_fitted:
            row[: self._eye_outputs] = 0.0
        else:
            row[: self._eye_outputs] = self.eye.see(stack)
        row[self._eye_outputs :] = self._history.row
        return row
