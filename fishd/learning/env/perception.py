"""The inputs of a policy's network: the outputs of the feature extractor, then the features."""

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.policy.card import ONE_TICK, Feature, History, Window
from fishd.core.camera_frames import Stack
from fishd.core.signals import Observation
from fishd.learning.extractors import FeatureExtractor


class Perception:
    """A conversion of observations, and stacks of frames, to inputs of a network."""

    def __init__(
        self,
        features: tuple[Feature, ...],
        extractor: FeatureExtractor | None = None,
        window: Window = ONE_TICK,
    ) -> None:
        """window: ticks that the features are from"""
        self.features = features
        self.extractor = extractor
        self.window = window
        self._history = History(features, window)
        self.numbers = len(self._history.row)
        """Number of inputs beside the outputs of the feature extractor."""
        self._extractor_outputs = extractor.outputs if extractor else 0
        self.inputs = self._extractor_outputs + self.numbers
        """Number of all inputs."""

    def with_new_history(self) -> "Perception":
        """Return the same perception for another swim, with an empty history."""
        return Perception(self.features, self.extractor, self.window)

    def forget(self) -> None:
        """Empty the history, since another fish follows."""
        self._history.forget()

    def note(self, observation: Observation) -> None:
        """Add a tick to the history, if there is one; `vector` does that, too."""
        if self.window.ticks > 1:
            self._history.push(observation)

    def vector(self, observation: Observation, stack: Stack | None = None) -> NDArray[np.float32]:
        """Return the inputs, shape (inputs,); stack: needed if there is a feature extractor."""
        self._history.push(observation)
        if self.extractor is None:
            return self._history.row.copy()
        row = np.empty(self.inputs, np.float32)
        if stack is None or not self.extractor.is_fitted:
            row[: self._extractor_outputs] = 0.0
        else:
            row[: self._extractor_outputs] = self.extractor.see(stack)
        row[self._extractor_outputs :] = self._history.row
        return row
