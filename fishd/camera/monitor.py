"""State of a camera: condition, start of the condition, rate, latency and lost frames."""

import os
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from fishd import __version__
from fishd.camera.messages import CameraState, Condition
from fishd.camera.settings import CameraSettings
from fishd.camera.sources.base import Timeline, Trouble

_RECENT_FRAMES = 30
"""Number of latest frames from which rate and latency are computed."""
_MAX_SILENCE_S = 2.0
"""Time without a frame after which rate and latency are reset; at low rates it is three periods
[s]."""


class _Recent(NamedTuple):
    time: float
    latency: float
    arrived: float


class Monitor:
    """Counters and condition of a camera; for one thread."""

    def __init__(
        self,
        settings: CameraSettings,
        device: str,
        frames: str,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """device: camera for people; frames: address of the PUB socket; now: reads the clock [s]"""
        self._now = now
        self._settings = settings
        self._device = device
        self._frames = frames
        self._start = now()
        self._recent: deque[_Recent] = deque(maxlen=_RECENT_FRAMES)
        self._trouble: Trouble | None = None
        self._exposure: float | None = None
        self._picture = (0, 0)
        self.condition: Condition = "starting"
        self._entered = self._start
        """Time at which the condition began, on the clock of `now` [s]."""
        self.timeline = Timeline(False, "", None)
        self.limitations: tuple[str, ...] = ()
        self.session = ""
        self.seq = self.dropped = self.broken = 0
        self.until: float | None = None

    @property
    def line(self) -> str:
        """Condition in one line, for a log."""
        if self._trouble is None:
            return f"{self.condition} from {self._device}"
        remedy = f"; {self._trouble.remedy}" if self._trouble.remedy else ""
        return f"{self.condition}: {self._trouble}{remedy}"

    def begin(self, session: str, timeline: Timeline, limitations: tuple[str, ...]) -> None:
        """Start a new session."""
        self.session, self.timeline, self.limitations = session, timeline, limitations
        self.seq, self.until = 0, None
        self._recent.clear()

    def frame(
        self, moment: float, available: float, exposure: float | None, picture: tuple[int, int]
    ) -> bool:
        """Count a frame; return whether the condition has changed.

        moment, available: times of the frame [s]; exposure: exposure time [s]
        picture: height and width of the whole picture [px]
        """
        self.seq += 1
        self._recent.append(_Recent(moment, available - moment, self._now()))
        self._exposure, self._picture = exposure, picture
        return self._enter("streaming", None)

    def trouble(self, trouble: Trouble) -> bool:
        """Enter a condition without frames; return whether it or its reason has changed."""
        self._recent.clear()
        return self._enter(trouble.condition, trouble)

    def _enter(self, condition: Condition, trouble: Trouble | None) -> bool:
        changed = condition != self.condition or str(trouble) != str(self._trouble)
        if condition != self.condition:
            self.condition, self._entered = condition, self._now()
        self._trouble = trouble
        return changed

    def state(self) -> CameraState:
        """Return the current state."""
        self._forget_old()
        size = self._settings.picture.size
        timeline, wall, now = self.timeline, time.time(), self._now()
        return CameraState(
            t=wall,
            version=__version__,
            pid=os.getpid(),
            uptime=now - self._start,
            session=self.session,
            source=self._settings.source,
            device=self._device,
            state=self.condition,
            since=wall - (now - self._entered),
            problem=str(self._trouble) if self._trouble else "",
            remedy=self._trouble.remedy if self._trouble else "",
            limitations=self.limitations,
            rate=self._rate(),
            latency=self._latency(),
            exposure=self._exposure,
            seq=self.seq,
            dropped_frames=self.dropped,
            broken_frames=self.broken,
            width=size,
            height=size,
            picture_width=self._picture[1],
            picture_height=self._picture[0],
            virtual=timeline.virtual,
            until=self.until,
            clock=timeline.now() if timeline.now else None,
            boot_id=timeline.boot,
            frames=self._frames,
        )

    def _forget_old(self) -> None:
        """Reset the recent frames after a silence, except on a virtual clock, which stops then."""
        if self.timeline.virtual or not self._recent:
            return
        first, last = self._recent[0].arrived, self._recent[-1].arrived
        mean_period = (last - first) / max(1, len(self._recent) - 1)
        if self._now() - last > max(_MAX_SILENCE_S, 3.0 * mean_period):
            self._recent.clear()

    def _rate(self) -> float:
        if len(self._recent) < 2:
            return 0.0
        duration = self._recent[-1].time - self._recent[0].time
        return (len(self._recent) - 1) / duration if duration > 0.0 else 0.0

    def _latency(self) -> float | None:
        if not self._recent:
            return None
        return sum(frame.latency for frame in self._recent) / len(self._recent)
