"""Estimate of the axis of motion that is updated while frames arrive."""

import random
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from fishd.camera.axis import Axis, NoMotion, find_motion
from fishd.core.camera_frames import Frame, Pixels

FRAME_SPAN_S = 20.0
"""Age of the oldest frame that the estimate uses [s]."""
FRAME_GAPS_S = (0.02, 0.08)
"""Range of the random minimum time between two kept frames [s]. With a fixed time, all kept frames
could show the same few phases of the beat."""
SEARCH_PERIOD_S = 3.0
"""Shortest time between two estimates, because one takes a tenth of a second [s]."""
_EMPTY_PICTURE = np.zeros((1, 1), np.uint8)
MIN_FRAMES = 40
"""Smallest number of frames for an estimate."""


class AxisWatch:
    """Estimator of the axis; `add` takes every frame."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self.axis: Axis | None = None
        """Latest axis; it stays valid while the fish rests, because the camera does not move."""
        self.moving = False
        """Whether there was motion in the latest search."""
        self._now = now
        self._frames: deque[tuple[float, Pixels]] = deque(
            maxlen=round(FRAME_SPAN_S / FRAME_GAPS_S[0])
        )
        self._random = random.Random(0)
        self._gap = 0.0
        self._next_search = now() + SEARCH_PERIOD_S

    def __len__(self) -> int:
        """Return the number of frames that the next search will use."""
        return len(self._frames)

    def add(self, frame: Frame) -> None:
        """Take a frame; reset on a frame of another size or with an earlier time."""
        if self._frames:
            latest_time, pixels = self._frames[-1]
            if pixels.shape != frame.pixels.shape or frame.time < latest_time:
                self._frames.clear()
                self.axis, self.moving = None, False
            elif frame.time - latest_time < self._gap:
                return
            self._gap = self._random.uniform(*FRAME_GAPS_S)
        self._frames.append((frame.time, frame.pixels))
        while frame.time - self._frames[0][0] > FRAME_SPAN_S:
            self._frames.popleft()

    @property
    def due(self) -> bool:
        """Whether it is time to search for the axis."""
        return len(self._frames) >= MIN_FRAMES and self._now() >= self._next_search

    def find(self) -> None:
        """Search for the axis; this takes a tenth of a second."""
        self._next_search = self._now() + SEARCH_PERIOD_S
        try:
            pictures = np.stack([pixels for _, pixels in self._frames or [(0.0, _EMPTY_PICTURE)]])
            self.axis = find_motion(pictures).axis
            self.moving = True
        except NoMotion:
            self.moving = False
