"""Frames of a camera, and the choice of the frames that a policy sees in a tick."""

from collections import deque
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.core.schema import note, unit

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


class StackSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which frames a policy is shown in a tick; part of a policy that sees."""

    size: Annotated[int, unit("px", "Height and width of a frame.", ge=16, le=256)] = 84
    frames: Annotated[int, note("Frames in the stack, newest first.", ge=1, le=8)] = 4
    interval: Annotated[float, unit("s", "Time between two of them.", ge=1e-3, le=1)] = 0.05
    delay: Annotated[
        float,
        unit(
            "s",
            "The stack ends so long before the tick: as a camera delivers its frames late, frames "
            "of even distance are then to be had.",
            ge=0,
            le=1,
        ),
    ] = 0.0
    oldest: Annotated[
        float, unit("s", "A frame may be so much older than it should be.", ge=1e-3, le=2)
    ] = 0.15

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of a stack: frames, height, width."""
        return self.frames, self.size, self.size


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
