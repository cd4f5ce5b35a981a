"""Brings the frames of a running camera into a recording, and says when they stop and come back."""

import time
from typing import NamedTuple, Self

from fishd.camera.client import CameraClient
from fishd.camera.messages import FrameHeader
from fishd.client import Fish
from fishd.core import text
from fishd.core.camera_frames import Frame, Pixels
from fishd.core.errors import FishError
from fishd.recording.images import FrameHead

SILENCE = 2.0
"""Without a frame for so long, the camera counts as lost [s]."""
_WAITING = 1000
"""Frames that may wait for the first tick; older ones are dropped."""


class Taken(NamedTuple):
    """What has come since the last time."""

    news: list[str]
    """A line for each thing that its reader should know."""
    frames: list[tuple[FrameHead, Pixels]]


class CameraTap:
    """A camera whose frames are recorded; whatever becomes of it ends nothing."""

    def __init__(self, address: str | None, endpoint: str | None) -> None:
        """
        address: where the camera takes requests; None as `CameraClient` finds it
        endpoint: control socket of the fishd on whose clock times are wanted

        Raises `CameraLost`, `NoDaemon` and `Refused`.
        """
        self._fish = Fish(endpoint)
        try:
            self._client = CameraClient(address, fish=self._fish)
        except BaseException:
            self._fish.close()
            raise
        self._heard = time.monotonic()
        self._lost = False
        self._session = ""
        self._ahead: float | None = None
        """Unix time less that of fishd's clock [s]."""
        self._waiting: list[tuple[FrameHeader, Frame]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._client.close()
        self._fish.close()

    def heard(self, t: float, monotonic: float) -> None:
        """A tick says what time it is: unix, and on fishd's clock [s]."""
        if monotonic:
            self._ahead = t - monotonic

    def take(self) -> Taken:
        """What has come since the last time; raises nothing of the camera's."""
        news: list[str] = []
        while found := self._poll():
            self._waiting += found
        if self._waiting:
            self._heard = time.monotonic()
            session = self._waiting[-1][0].session
            if self._lost or (self._session and session != self._session):
                news.append("the camera is there again: its frames are recorded")
            self._lost, self._session = False, session
        elif time.monotonic() - self._heard > SILENCE and not self._lost:
            self._lost = True
            news.append(f"no frames come from the camera: {self._why()}; the recording goes on")
        if self._ahead is None:
            self._waiting = self._waiting[-_WAITING:]
            return Taken(news, [])
        waiting, self._waiting = self._waiting, []
        return Taken(news, [(self._head(*each), each[1].pixels) for each in waiting])

    def _poll(self) -> list[tuple[FrameHeader, Frame]]:
        try:
            return self._client.poll_with_headers()
        except FishError:  # a fishd that has just ended cannot tell its clock
            return []

    def _why(self) -> str:
        try:
            state = self._client.status()
        except FishError:
            return "it does not answer"
        said = "; ".join(filter(None, (state.problem, state.remedy)))
        return text.line(f"it is {state.state}" + (f": {said}" if said else ""))

    def _head(self, header: FrameHeader, frame: Frame) -> FrameHead:
        assert self._ahead is not None
        return FrameHead(
            t=frame.time + self._ahead,
            time=frame.time,
            available=frame.available,
            seq=header.seq,
            session=header.session,
            exposure=header.exposure,
            dropped=header.dropped,
        )
