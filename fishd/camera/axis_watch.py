"""Follows the axis of motion while frames come: known once the tail has moved for a while."""

import random
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from fishd.camera.axis import Axis, NoMotion, find_motion
from fishd.core.camera_frames import Frame, Pixels

SPAN = 20.0
"""It is found in the frames of so long [s]."""
APART = (0.02, 0.08)
"""The time from one frame to the next that is kept is at least a random one between these [s]: at
even distances, a beat would be seen in the same few phases again and again."""
AGAIN = 3.0
"""It is looked for so often at most, as that takes a tenth of a second [s]."""
_NONE = np.zeros((1, 1), np.uint8)
FEWEST = 40
"""Frames that are needed."""


class AxisWatch:
    """Is shown every frame."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.axis: Axis | None = None
        """The latest that was found; the camera stands still while the fish rests."""
        self.moving = False
        """Did anything move when it was looked for last?"""
        self._now = now
        self._frames: deque[tuple[float, Pixels]] = deque(maxlen=round(SPAN / APART[0]))
        self._random = random.Random(0)
        self._apart = 0.0
        self._next = now() + AGAIN

    def __len__(self) -> int:
        """How many frames it would look at."""
        return len(self._frames)

    def add(self, frame: Frame) -> None:
        """Take a frame; another size, or an earlier time, begins anew."""
        if self._frames:
            before, pixels = self._frames[-1]
            if pixels.shape != frame.pixels.shape or frame.time < before:
                self._frames.clear()
                self.axis, self.moving = None, False
            elif frame.time - before < self._apart:
                return
            self._apart = self._random.uniform(*APART)
        self._frames.append((frame.time, frame.pixels))
        while frame.time - self._frames[0][0] > SPAN:
            self._frames.popleft()

    @property
    def due(self) -> bool:
        """Is it time to look for the axis?"""
        return len(self._frames) >= FEWEST and self._now() >= self._next

    def find(self) -> None:
        """Look for the axis; takes a tenth of a second."""
        self._next = self._now() + AGAIN
        try:
            pictures = np.stack([pixels for _, pixels in self._frames or [(0.0, _NONE)]])
            self.axis = find_motion(pictures).axis
            self.moving = True
        except NoMotion:
            self.moving = False
