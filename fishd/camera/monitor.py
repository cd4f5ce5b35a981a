"""What a camera says of itself: its state and since when, rate, latency, what was lost."""

import os
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from fishd import __version__
from fishd.camera.messages import CameraState, Condition
from fishd.camera.settings import CameraSettings
from fishd.camera.sources.base import Timeline, Trouble

_LATE = 30
"""Frames that count as those of late."""
_OLD = 2.0
"""They are not of late any more when none has come for so long, or for three times as long as from
one to the next [s]."""


class _Recent(NamedTuple):
    time: float
    latency: float
    arrived: float


class Monitor:
    """Keeps count; for one thread."""

    def __init__(
        self,
        settings: CameraSettings,
        device: str,
        frames: str,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """device: what is opened, for people; frames: address of the PUB socket; now: [s]"""
        self._now = now
        self._settings = settings
        self._device = device
        self._frames = frames
        self._began = now()
        self._recent: deque[_Recent] = deque(maxlen=_LATE)
        self._trouble: Trouble | None = None
        self._exposure: float | None = None
        self._picture = (0, 0)
        self.condition: Condition = "starting"
        self.since = time.time()
        self.timeline = Timeline(False, "", None)
        self.degraded: tuple[str, ...] = ()
        self.session = ""
        self.seq = self.dropped = self.broken = 0
        self.until: float | None = None

    @property
    def line(self) -> str:
        """The state in one line, for a log."""
        if self._trouble is None:
            return f"{self.condition} from {self._device}"
        remedy = f"; {self._trouble.remedy}" if self._trouble.remedy else ""
        return f"{self.condition}: {self._trouble}{remedy}"

    def begin(self, session: str, timeline: Timeline, degraded: tuple[str, ...]) -> None:
        """Another session."""
        self.session, self.timeline, self.degraded = session, timeline, degraded
        self.seq, self.until = 0, None
        self._recent.clear()

    def frame(
        self, moment: float, available: float, exposure: float | None, picture: tuple[int, int]
    ) -> bool:
        """Count a frame; true where the state is another one now.

        moment, available: its times [s]; exposure: its length [s]; picture: height and width [px]
        """
        self.seq += 1
        self._recent.append(_Recent(moment, available - moment, self._now()))
        self._exposure, self._picture = exposure, picture
        return self._enter("streaming", None)

    def trouble(self, trouble: Trouble) -> bool:
        """There are no frames; true where that is news."""
        self._recent.clear()
        return self._enter(trouble.condition, trouble)

    def _enter(self, condition: Condition, trouble: Trouble | None) -> bool:
        news = condition != self.condition or str(trouble) != str(self._trouble)
        if condition != self.condition:
            self.condition, self.since = condition, time.time()
        self._trouble = trouble
        return news

    def state(self) -> CameraState:
        """All of it, now."""
        self._forget_old()
        size = self._settings.picture.size
        timeline = self.timeline
        return CameraState(
            t=time.time(),
            version=__version__,
            pid=os.getpid(),
            uptime=self._now() - self._began,
            session=self.session,
            source=self._settings.source,
            device=self._device,
            state=self.condition,
            since=self.since,
            problem=str(self._trouble) if self._trouble else "",
            remedy=self._trouble.remedy if self._trouble else "",
            degraded=self.degraded,
            rate=self._rate(),
            latency=self._latency(),
            exposure=self._exposure,
            seq=self.seq,
            dropped=self.dropped,
            broken=self.broken,
            width=size,
            height=size,
            picture_width=self._picture[1],
            picture_height=self._picture[0],
            virtual=timeline.virtual,
            until=self.until,
            clock=timeline.now() if timeline.now else None,
            boot=timeline.boot,
            frames=self._frames,
        )

    def _forget_old(self) -> None:
        """Virtual time stands still while no frames come: there, none grow old."""
        if self.timeline.virtual or not self._recent:
            return
        first, last = self._recent[0].arrived, self._recent[-1].arrived
        usual = (last - first) / max(1, len(self._recent) - 1)
        if self._now() - last > max(_OLD, 3.0 * usual):
            self._recent.clear()

    def _rate(self) -> float:
        if len(self._recent) < 2:
            return 0.0
        passed = self._recent[-1].time - self._recent[0].time
        return (len(self._recent) - 1) / passed if passed > 0.0 else 0.0

    def _latency(self) -> float | None:
        if not self._recent:
            return None
        return sum(each.latency for each in self._recent) / len(self._recent)
