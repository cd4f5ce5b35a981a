"""Frames of a camera, and the selection of the frames that a policy sees in a tick."""

from collections import deque
from typing import TYPE_CHECKING, Annotated, NamedTuple, TypeAlias

from msgspec import Struct

from fishd.core.schema import note, unit

if TYPE_CHECKING:  # programs that list recordings need no numpy
    import numpy as np
    from numpy.typing import NDArray

Pixels: TypeAlias = "NDArray[np.uint8]"
"""Grey levels, shape (height, width)."""


Stack = tuple[Pixels, ...]
"""Frames of one size, newest first."""

TIME_TOLERANCE_S = 1e-6
"""Largest difference of two times that count as equal [s]."""


class Frame(NamedTuple):
    """One picture of the tail."""

    time: float
    """Middle of the exposure [s, monotonic clock of fishd]."""
    available: float
    """Time of arrival, on the same clock [s]."""
    pixels: Pixels


class FrameHead(Struct, frozen=True, gc=False):
    """Metadata of a recorded frame, without its picture."""

    t: Annotated[float, unit("s", "Middle of the exposure, unix.")]
    time: Annotated[
        float, unit("s", "Middle of the exposure on fishd's monotonic clock, as `time` of a tick.")
    ]
    available: Annotated[float, unit("s", "Time of arrival of the frame, on that clock.")]
    seq: Annotated[int, note("Number of the frame in its session, from 1.")]
    session: Annotated[str, note("Identifier of one run of the camera on one clock.")]
    exposure: Annotated[
        float | None, unit("s", "Duration of the exposure; omitted if unknown.")
    ] = None
    dropped_frames: Annotated[
        int, note("Number of frames that the camera took but did not deliver, since its start.")
    ] = 0


class StackSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the frames that a policy with a camera gets in a tick; part of such a policy."""

    size: Annotated[int, unit("px", "Height and width of a frame.", ge=16, le=256)] = 84
    frames: Annotated[int, note("Frames in the stack, newest first.", ge=1, le=8)] = 4
    interval: Annotated[
        float, unit("s", "Time between two frames of the stack.", ge=1e-3, le=1)
    ] = 0.05
    delay: Annotated[
        float,
        unit(
            "s",
            "Time by which the newest frame of the stack precedes the tick: the camera's frames "
            "arrive late, and with this delay frames at even intervals are available.",
            ge=0,
            le=1,
        ),
    ] = 0.0
    oldest: Annotated[
        float, unit("s", "Maximum time by which a frame may be too old.", ge=1e-3, le=2)
    ] = 0.15

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of a stack: frames, height, width."""
        return self.frames, self.size, self.size


class FrameHistory:
    """Buffer of the latest frames, in the order of their times."""

    def __init__(self, settings: StackSettings) -> None:
        self.settings = settings
        self._frames: deque[Frame] = deque(maxlen=_MAX_FRAMES)
        span = settings.delay + (settings.frames - 1) * settings.interval + settings.oldest
        self._span = span + _MAX_LEAD_S

    def add(self, frame: Frame) -> None:
        """Store a frame; drop it if it is not newer than all others."""
        frames = self._frames
        if frames and frame.time <= frames[-1].time:
            return
        frames.append(frame)
        while frames[0].time < frame.time - self._span:
            frames.popleft()

    def clear(self) -> None:
        """Remove all frames."""
        self._frames.clear()

    def stack(self, tick: float) -> Stack | None:
        """Return the frames that a policy gets at `tick` [s].

        The k-th frame is the newest that was exposed at or before tick - delay - k·interval and had
        arrived by the tick. None if a frame is missing, or older than permitted.
        """
        settings = self.settings
        latest_time = tick - settings.delay + TIME_TOLERANCE_S
        chosen: list[Pixels] = []
        for frame in reversed(self._frames):
            if frame.available > tick + TIME_TOLERANCE_S:
                continue
            while frame.time <= latest_time:
                if frame.time < latest_time - settings.oldest:
                    return None
                chosen.append(frame.pixels)
                if len(chosen) == settings.frames:
                    return tuple(chosen)
                latest_time -= settings.interval
        return None


_MAX_LEAD_S = 2.0
"""Maximum time by which a frame may arrive before the tick that uses it [s]."""
_MAX_FRAMES = 4096
"""Maximum number of stored frames."""
