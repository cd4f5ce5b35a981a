"""Source of the frames of a running camera for a recording; reports when they stop and return."""

import time
from typing import Self

from fishd.camera.client import CameraClient
from fishd.camera.messages import FrameHeader
from fishd.client import Fish
from fishd.core import text
from fishd.core.camera_frames import Frame, FrameHead, Pixels
from fishd.core.errors import FishError
from fishd.core.tail_reading import RecordedTail

CAMERA_TIMEOUT_S = 2.0
"""Time without a frame after which the camera counts as lost [s]."""
POLL_INTERVAL_S = 0.02
"""Interval at which the last frames of a recording are awaited [s]."""
LAST_FRAMES_TIMEOUT_S = 1.0
"""Longest wait for the last frames of a recording [s]."""
_SHARED_FIELDS = {*RecordedTail.__struct_fields__} - {"t"}
"""Names of the fields that a fin angle has in a recording as in its message."""
_MAX_WAITING_FRAMES = 1000
"""Maximum number of frames that wait for the first tick; older ones are dropped."""


class CameraTap:
    """A camera whose frames and fin angles are recorded; its errors never end the recording."""

    def __init__(self, address: str | None, endpoint: str | None) -> None:
        """
        address: address of the camera's request socket; None for the one that `CameraClient` finds
        endpoint: control socket of the fishd whose clock gives the times

        Raises `CameraLost`, `NoDaemon` and `Refused`.
        """
        self._fish = Fish(endpoint)
        try:
            self._client = CameraClient(address, fish=self._fish, tail=True)
        except BaseException:
            self._fish.close()
            raise
        self._expected = self._client.state.session, self._client.state.seq
        """Session and number of the latest frame that is not to be recorded, or that has come."""
        self._heard = time.monotonic()
        self._lost = False
        self._session = ""
        self._ahead: float | None = None
        """Unix time minus the time of fishd's clock [s]."""
        self._waiting: list[tuple[FrameHeader, Frame]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._client.close()
        self._fish.close()

    def refuse_unmeasured(self) -> None:
        """Raise `Refused` where the camera does not measure the fin angle."""
        self._client.state.refuse_unmeasured()

    def set_time(self, t: float, monotonic: float) -> None:
        """Set the clock offset from the times of a tick: unix, and on fishd's clock [s]."""
        if monotonic:
            self._ahead = t - monotonic

    def take(self) -> tuple[list[str], list[tuple[FrameHead, Pixels]]]:
        """Return the news and frames since the previous call; raise no error of the camera.

        The news have one line for the user per change of the camera's state.
        """
        news: list[str] = []
        while frames := self._poll():
            self._waiting += frames
        if self._waiting:
            self._heard = time.monotonic()
            session = self._waiting[-1][0].session
            if self._lost or (self._session and session != self._session):
                news.append("the camera is back: its frames are recorded")
            self._lost, self._session = False, session
        elif time.monotonic() - self._heard > CAMERA_TIMEOUT_S and not self._lost:
            self._lost = True
            news.append(f"no frames come from the camera: {self._why()}; the recording continues")
        if self._ahead is None:
            self._waiting = self._waiting[-_MAX_WAITING_FRAMES:]
            return news, []
        waiting, self._waiting = self._waiting, []
        return news, [(self._head(*pair), pair[1].pixels) for pair in waiting]

    def take_tails(self) -> list[RecordedTail]:
        """Return the fin angles since the previous call; none before the first tick."""
        if self._ahead is None:
            return []
        return [
            RecordedTail(
                t=tail.time + self._ahead,
                **{name: getattr(tail, name) for name in _SHARED_FIELDS},
            )
            for tail in self._client.take_tails()
        ]

    def count_missing(self) -> int | None:
        """Return how many published frames have not arrived; None if the camera does not say.

        Those that arrive meanwhile are in the result of the next `take`.
        """
        try:
            state = self._client.status()
        except FishError:
            return None
        deadline = time.monotonic() + LAST_FRAMES_TIMEOUT_S
        while True:
            self._waiting += self._poll()
            session, seq = self._expected
            if self._client.latest:
                header = self._client.latest.header
                session, seq = header.session, header.seq
            if session != state.session:
                return None
            if seq >= state.seq or time.monotonic() > deadline:
                return max(0, state.seq - seq)
            time.sleep(POLL_INTERVAL_S)

    def _poll(self) -> list[tuple[FrameHeader, Frame]]:
        try:
            return self._client.poll_with_headers()
        except FishError:  # a fishd that has just ended cannot give its time
            return []

    def _why(self) -> str:
        try:
            state = self._client.status()
        except FishError:
            return "it does not answer"
        explanation = "; ".join(filter(None, (state.problem, state.remedy)))
        return text.line(f"it is {state.state}" + (f": {explanation}" if explanation else ""))

    def _head(self, header: FrameHeader, frame: Frame) -> FrameHead:
        assert self._ahead is not None
        return FrameHead(
            t=frame.time + self._ahead,
            time=frame.time,
            available=frame.available,
            seq=header.seq,
            session=header.session,
            exposure=header.exposure,
            dropped_frames=header.dropped_frames,
        )
