"""`CameraClient`: frames of a running `fishd-camera`, with their times on the clock of fishd."""

import time
from collections.abc import Iterator
from typing import Self

import zmq

from fishd.camera import messages
from fishd.camera.clock_offset import ClockOffset, Offset, Reading, clock_of
from fishd.camera.messages import (
    BadMessage,
    CameraState,
    FrameHeader,
    PublishedFrame,
    PublishedView,
    Until,
)
from fishd.camera.requests import (
    LONGEST,
    CameraLost,
    CameraRequests,
    connect,
    find_camera,
    reachable,
)
from fishd.camera.settings import CameraSettings
from fishd.client import Fish
from fishd.client.zmq_sockets import milliseconds_until
from fishd.core import text
from fishd.core.camera_frames import EQUAL, Frame, FrameHistory, Stack, StackSettings
from fishd.core.errors import FishError

__all__ = ["CameraClient", "CameraLost"]

TIMEOUT = 2.0
"""How long to wait for an answer, or for a frame, until the camera counts as lost [s]."""
PATIENCE = 5.0
"""How long a tick in lockstep may wait for its frames [s]."""
WAITING = 256
"""Messages that may wait for a client that is busy."""
_ASK = 0.5
"""In lockstep the camera is asked after so long without a word [s]."""
_BETWEEN = 0.02
"""Longest time between two looks at whether all has come that an answer speaks of [s]."""


class CameraClient:
    """A connection to a camera; a context manager, for one thread.

    Frames that come wait here until `poll`, `stack_at` or `views` takes them. A camera that ends
    and comes back is followed.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        fish: Fish | None = None,
        stack: StackSettings | None = None,
        views: bool = False,
        frames: str | None = None,
        timeout: float = TIMEOUT,
    ) -> None:
        """
        endpoint: where the camera takes requests; None: $FISHD_CAMERA, else that of this machine
        fish: the fishd on whose clock times are wanted; None leaves them on the camera's clock
        stack: which frames `stack_at` gives
        views: take the JPEG pictures for people, too
        frames: address of its frames; None asks the camera
        timeout: how long to wait for an answer, or for a frame [s]

        Raises `CameraLost` when no camera answers, `Refused` when it speaks another version.
        """
        self.endpoint = endpoint or find_camera()
        self._timeout = timeout
        self.history = FrameHistory(stack or StackSettings())
        """The latest frames, with their times on the clock of `fish`."""
        self.latest: PublishedFrame | None = None
        """The newest frame as the camera sent it."""
        self.view: PublishedView | None = None
        """The newest picture for people."""
        self.strange = 0
        """Messages that were none of a camera, or of another version."""
        self.missed = 0
        """Frames that were sent but have not come."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._heard = time.monotonic()
        self._until: float | None = None
        self._until_moved = False
        self._seen = 0
        """Up to this number all frames of the session have come that will come."""
        self._complaint = ""
        try:
            self._requests = CameraRequests(self.endpoint, self._context, timeout)
            self.state = self.status()
            self._session = self.state.session
            self._camera_clock = ClockOffset(self._read_clock)
            self._fishd_clock = ClockOffset(clock_of(fish)) if fish else None
            self._subscribe(frames or reachable(self.state.frames, self.endpoint), views)
            self._await_subscription()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._context.destroy(linger=0)

    def status(self) -> CameraState:
        """What the camera says of itself; raises `CameraLost`."""
        return self._requests.status()

    def settings(self) -> CameraSettings:
        """The settings that it was started with, but for a password; raises `CameraLost`."""
        return self._requests.settings()

    def offset(self) -> Offset:
        """What is added to the camera's times to have those of fishd; raises `FishError`."""
        if self._fishd_clock is None or self.state.virtual:
            return Offset(0.0, 0.0)
        fishd, camera = self._fishd_clock.update(), self._camera_clock.update()
        return Offset(fishd.seconds - camera.seconds, fishd.uncertainty + camera.uncertainty)

    def poll(self, seconds: float = 0.0) -> list[Frame]:
        """The frames that have come since the last call; waits so long for the first of them [s].

        They are in `history`, too. Raises `FishError` where a clock could never be asked; frames
        whose time is not known since a camera or fishd began anew are left out.
        """
        return [frame for _, frame in self.poll_with_headers(seconds)]

    def poll_with_headers(self, seconds: float = 0.0) -> list[tuple[FrameHeader, Frame]]:
        """The same, each with what the camera said of it."""
        deadline = time.monotonic() + seconds
        found: list[tuple[FrameHeader, Frame]] = []
        while not found and self._socket.poll(milliseconds_until(deadline)):
            found = self._take_all()
            if self._until_moved:
                break
        return found

    def frames(self) -> Iterator[Frame]:
        """Every frame from now on; raises `CameraLost` when none comes in time."""
        while True:
            yield from self.poll(self._timeout)
            self.check()

    def views(self) -> Iterator[PublishedView]:
        """Every picture for people from now on; raises `CameraLost` when frames stop coming."""
        seen = self.view
        while True:
            self.poll(0.1)
            if self.view is not None and self.view is not seen:
                seen = self.view
                yield seen
            self.check()

    def stack_at(self, tick: float, patience: float = PATIENCE) -> Stack | None:
        """What a policy is shown in the tick at `tick` [s, clock of fishd].

        None where a frame is missing. In lockstep it
        waits until the camera has shown all of the time before the tick. In real time it takes
        what has come.

        patience: longest wait [s]
        Raises `CameraLost` when the camera is gone, or has no frames.
        """
        while self.poll():
            pass
        if self.state.virtual:
            self._await(tick, patience)
        else:
            self.check()
        return self.history.stack(tick)

    def check(self) -> None:
        """Raises `CameraLost` when frames have not come for `timeout`, and says why."""
        silent = time.monotonic() - self._heard
        if silent <= self._timeout:
            return
        self.state = self.status()
        raise CameraLost(self._why(silent))

    def _await(self, tick: float, patience: float) -> None:
        """Wait until all frames before a tick have come."""
        deadline = time.monotonic() + patience
        while self._until is None or self._until < tick - EQUAL:
            heard = self._heard
            wait = min(_ASK, max(0.0, deadline - time.monotonic())) if self._until else _BETWEEN
            self.poll(wait)
            if self._until is not None and self._until >= tick - EQUAL:
                return
            if self._heard > heard and time.monotonic() < deadline:
                continue
            state = self.status()
            self._follow(state)
            if state.until is None:
                return  # this fishd has not ended a tick since the camera knows it
            self._await_frames(state, deadline)
            if self._session != state.session:
                continue
            # What was published before this client had subscribed will not come any more.
            self._until = max(self._until or 0.0, state.until)
            if self._until < tick - EQUAL and time.monotonic() >= deadline:
                raise CameraLost(
                    f"the camera at {self.endpoint} has no frames for the tick at {tick:.3f} s: it "
                    f"has come to {self._until:.3f} s and is {self.state.state}"
                    + self._in_its_words()
                )

    def _await_frames(self, state: CameraState, deadline: float) -> None:
        """Wait for the frames that an answer speaks of: it may overtake them.

        Their socket brings the state twice a second, too, behind all frames that it counts.
        """
        while self._session == state.session and self._seen < state.seq:
            left = deadline - time.monotonic()
            if left <= 0.0:
                return
            self.poll(min(_BETWEEN, left))

    def _why(self, silent: float) -> str:
        camera = f"the camera at {self.endpoint}"
        if self.state.state != "streaming":
            ago = max(0.0, self.state.t - self.state.since)
            return f"{camera} has been {self.state.state} for {ago:.0f} s" + self._in_its_words()
        if self._complaint:
            return f"{camera} sends what cannot be used: {self._complaint}"
        return (
            f"{camera} says that it streams, but no frame has come from {self.state.frames} for "
            f"{silent:.0f} s; can this machine reach that address?"
        )

    def _in_its_words(self) -> str:
        said = "; ".join(filter(None, (self.state.problem, self.state.remedy)))
        return f": {text.line(said)}" if said else ""

    def _subscribe(self, address: str, views: bool) -> None:
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, WAITING)
        self._socket.set(zmq.MAXMSGSIZE, LONGEST)
        self._socket.set(zmq.RECONNECT_IVL, 20)
        self._socket.set(zmq.RECONNECT_IVL_MAX, 500)
        topics = [messages.FRAME, messages.STATE, messages.UNTIL]
        for topic in [*topics, messages.VIEW] if views else topics:
            self._socket.subscribe(topic)
        connect(self._socket, address)

    def _await_subscription(self) -> None:
        """The camera tells its state to whoever subscribes: from then on nothing is missed."""
        if not self._socket.poll(int(self._timeout * 1e3)):
            raise CameraLost(
                f"the camera at {self.endpoint} answers, but nothing comes from its frames at "
                f"{self.state.frames}; can this machine reach that address?"
            )

    def _take_all(self) -> list[tuple[FrameHeader, Frame]]:
        found: list[tuple[FrameHeader, Frame]] = []
        self._until_moved = False
        for _ in range(WAITING):
            try:
                message = messages.decode(self._socket.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                break
            except BadMessage as error:
                self.strange += 1
                self._complaint = str(error)
                continue
            if isinstance(message, PublishedFrame):
                if frame := self._take(message):
                    found.append((message.header, frame))
            elif isinstance(message, PublishedView):
                self.view = message
            elif isinstance(message, Until):
                self._enter(message.session)
                self._until, self._until_moved = message.until, True
                self._heard = time.monotonic()
            else:
                self._follow(message)
                self._seen = max(self._seen, message.seq)
        return found

    def _take(self, published: PublishedFrame) -> Frame | None:
        """Keep a frame; None where its time on the clock of fishd is not known."""
        header = published.header
        self._enter(header.session)
        if self.latest and self.latest.header.session == header.session:
            self.missed += max(0, header.seq - self.latest.header.seq - 1)
        self.latest = published
        self._seen = max(self._seen, header.seq)
        offset = self._seconds_to_add(header)
        if offset is None:
            return None
        self._heard = time.monotonic()
        frame = Frame(header.time + offset, header.available + offset, published.pixels)
        self.history.add(frame)
        return frame

    def _seconds_to_add(self, header: FrameHeader) -> float | None:
        """To its times; raises `FishError` where the clocks have never been known."""
        if header.virtual:
            return 0.0
        try:
            return self.offset().seconds
        except FishError as error:
            if not all(each.known for each in (self._camera_clock, self._fishd_clock) if each):
                raise
            self._complaint = str(error)
            return None

    def _follow(self, state: CameraState) -> None:
        self._enter(state.session)
        self.state = state

    def _enter(self, session: str) -> None:
        """Another session is another camera, or another clock."""
        if session != self._session:
            self._session = session
            self._until = None
            self._seen = 0
            self.history.clear()
            self._camera_clock.forget()
            if self._fishd_clock:
                self._fishd_clock.forget()

    def _read_clock(self, patience: float | None) -> Reading:
        state = self._requests.status(patience)
        if state.clock is None:
            raise CameraLost(
                f"the camera at {self.endpoint} does not tell its clock yet: it is {state.state}"
            )
        return Reading(state.clock, state.boot)
