"""Frames of a camera, and which of them a tick is shown: chosen by their times."""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.policy.card import StackSettings

__all__ = ["EQUAL", "Frame", "FrameHistory", "Pixels", "Stack", "StackSettings"]

Pixels = NDArray[np.uint8]
"""Grey levels, shape (height, width)."""


Stack = tuple[Pixels, ...]
"""Frames of one size, newest first."""

EQUAL = 1e-6
"""Times that differ by less are equal [s]."""


class Frame(NamedTuple):
    """One picture of the tail."""

    time: float
    """Middle of its exposure [s, monotonic clock of fishd]."""
    available: float
    """When it could first be had, on the same clock [s]."""
    pixels: Pixels


class FrameHistory:
    """The latest frames, in the order of their times."""

    def __init__(self, settings: StackSettings) -> None:
        self.settings = settings
        self._frames: deque[Frame] = deque(maxlen=_MOST)
        span = settings.delay + (settings.frames - 1) * settings.interval + settings.oldest
        self._span = span + _AHEAD

    def add(self, frame: Frame) -> None:
        """Keep a frame; one that is not newer than all others is dropped."""
        frames = self._frames
        if frames and frame.time <= frames[-1].time:
            return
        frames.append(frame)
        while frames[0].time < frame.time - self._span:
            frames.popleft()

    def clear(self) -> None:
        """Forget all frames."""
        self._frames.clear()

    def stack(self, tick: float) -> Stack | None:
        """What a policy is shown at `tick` [s].

        The k-th frame is the newest that was exposed at or before tick - delay - k·interval and had
        arrived by the tick. None where one of them is missing, or older than permitted.
        """
        settings = self.settings
        wanted = tick - settings.delay + EQUAL
        chosen: list[Pixels] = []
        for frame in reversed(self._frames):
            if frame.available > tick + EQUAL:
                continue
            while frame.time <= wanted:
                if frame.time < wanted - settings.oldest:
                    return None
                chosen.append(frame.pixels)
                if len(chosen) == settings.frames:
                    return tuple(chosen)
                wanted -= settings.interval
        return None


_AHEAD = 2.0
"""Frames may come so much earlier than the tick that they are for [s]."""
_MOST = 4096
"""Frames that are kept."""
