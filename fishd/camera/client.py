"""Client of a running `fishd-camera`: frames with their times on the clock of fishd."""

import time
from collections import deque
from collections.abc import Iterator
from typing import Self

import zmq
from msgspec.structs import replace

from fishd.camera import messages
from fishd.camera.clock_offset import ClockOffset, Offset, Reading, clock_reader
from fishd.camera.messages import (
    BadMessage,
    CameraState,
    FrameHeader,
    PublishedFrame,
    PublishedView,
    TailMessage,
    Until,
)
from fishd.camera.requests import (
    MAX_MESSAGE_BYTES,
    CameraLost,
    CameraRequests,
    connect,
    find_camera,
    resolve_frames_address,
)
from fishd.camera.settings import CameraSettings
from fishd.client import Fish
from fishd.client.zmq_sockets import Subscription, milliseconds_until
from fishd.core import text
from fishd.core.camera_frames import TIME_TOLERANCE_S, Frame, FrameHistory, Stack, StackSettings
from fishd.core.errors import FishError

__all__ = ["CameraClient", "CameraLost"]

TIMEOUT = 2.0
"""Time without an answer, or without a frame, after which the camera counts as lost [s]."""
LOCKSTEP_TIMEOUT_S = 5.0
"""Longest time that a tick in lockstep waits for its frames [s]."""
MAX_QUEUED_MESSAGES = 256
"""Largest number of messages that wait for a busy client."""
_MAX_WAITING_TAILS = 4096
"""Largest number of fin angles that wait until they are taken; older ones are dropped."""
_STATUS_PERIOD_S = 0.5
"""Time without a message in lockstep after which the camera's state is requested [s]."""
_POLL_PERIOD_S = 0.02
"""Longest time between two checks for the frames that an answer counts [s]."""


class CameraClient:
    """Connection to a camera; a context manager, for one thread.

    Frames wait in the socket until `poll`, `stack_at` or `views` takes them. A camera that ends and
    starts again is followed.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        fish: Fish | None = None,
        stack: StackSettings | None = None,
        views: bool = False,
        tail: bool = False,
        frames: str | None = None,
        timeout: float = TIMEOUT,
    ) -> None:
        """
        endpoint: address of the camera's requests; None: $FISHD_CAMERA, else that of this machine
        fish: the fishd to whose clock times are converted; None leaves them on the camera's clock
        stack: the frames that `stack_at` returns
        views: whether to receive the JPEG pictures for people, too
        tail: whether to receive the fin angles, too
        frames: address of the frames; None requests it from the camera
        timeout: longest wait for an answer, or for a frame [s]

        Raises `CameraLost` when no camera answers, `Refused` when it speaks another version.
        """
        self.endpoint = endpoint or find_camera()
        self._timeout = timeout
        self.history = FrameHistory(stack or StackSettings())
        """Latest frames, with their times on the clock of `fish`."""
        self.latest: PublishedFrame | None = None
        """Newest frame as the camera sent it."""
        self.view: PublishedView | None = None
        """Newest picture for people."""
        self._tails: deque[TailMessage] = deque(maxlen=_MAX_WAITING_TAILS)
        self.missed = 0
        """Number of frames that were sent but did not arrive."""
        self.requests = CameraRequests(self.endpoint, timeout)
        """Its other requests."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._last_message_time = time.monotonic()
        self._until: float | None = None
        self._until_moved = False
        self._last_seq = 0
        """Number of the latest frame of the session up to which no more frames will arrive."""
        self._last_problem = ""
        try:
            self.state = self.status()
            self._session = self.state.session
            self._camera_clock = ClockOffset(self._read_clock)
            self._fishd_clock = ClockOffset(clock_reader(fish)) if fish else None
            topics = [messages.FRAME, messages.UNTIL, messages.STATE]
            topics += [messages.VIEW] * views + [messages.TAIL] * tail
            self._subscribe(
                frames or resolve_frames_address(self.state.frames, self.endpoint), topics
            )
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
        self.requests.close()
        self._context.destroy(linger=0)

    def status(self) -> CameraState:
        """Return the camera's state; raises `CameraLost`."""
        return self.requests.status()

    def settings(self) -> CameraSettings:
        """Return the camera's settings, without a password; raises `CameraLost`."""
        return self.requests.settings()

    def offset(self) -> Offset:
        """Return the offset of fishd's clock from the camera's; raises `FishError`."""
        if self._fishd_clock is None or self.state.virtual:
            return Offset(0.0, 0.0)
        fishd, camera = self._fishd_clock.update(), self._camera_clock.update()
        return Offset(fishd.seconds - camera.seconds, fishd.uncertainty + camera.uncertainty)

    def poll(self, seconds: float = 0.0) -> list[Frame]:
        """Return the frames since the last call, and add them to `history`.

        seconds: longest wait for the first of them [s]

        Raises `FishError` where a clock has never answered. Frames whose time is unknown because
        the camera or fishd has restarted are left out.
        """
        return [frame for _, frame in self.poll_with_headers(seconds)]

    def poll_with_headers(self, seconds: float = 0.0) -> list[tuple[FrameHeader, Frame]]:
        """Return the frames as `poll` does, each with its header."""
        deadline = time.monotonic() + seconds
        frames: list[tuple[FrameHeader, Frame]] = []
        subscription = self._subscription
        while not frames and subscription.socket.poll(milliseconds_until(deadline)):
            frames = self._receive_all()
            if self._until_moved:
                break
        if not frames and subscription.is_dead():
            subscription.replace(subscription.address)
        return frames

    def take_tails(self) -> list[TailMessage]:
        """Return the fin angles since the last call that `poll` has received, times as frames'."""
        tails = list(self._tails)
        self._tails.clear()
        return tails

    def frames(self) -> Iterator[Frame]:
        """Yield every frame from now on; raises `CameraLost` when none arrives in time."""
        while True:
            yield from self.poll(self._timeout)
            self.check()

    def views(self) -> Iterator[PublishedView]:
        """Yield every picture for people from now on; raises `CameraLost` when frames stop."""
        seen = self.view
        while True:
            self.poll(0.1)
            if self.view is not None and self.view is not seen:
                seen = self.view
                yield seen
            self.check()

    def stack_at(self, tick: float, patience: float = LOCKSTEP_TIMEOUT_S) -> Stack | None:
        """Return the stack of frames for a policy in the tick at `tick` [s, clock of fishd].

        None where a frame is missing. In lockstep, wait until the camera has published all frames
        before the tick. In real time, use the frames that have arrived.

        patience: longest wait [s]
        Raises `CameraLost` when the camera does not answer, or has no frames.
        """
        while self.poll():
            pass
        if self.state.virtual:
            self._await_frames_until(tick, patience)
        else:
            self.check()
        return self.history.stack(tick)

    def check(self) -> None:
        """Raise `CameraLost` with the reason when no frame has arrived for `timeout`."""
        silent = time.monotonic() - self._last_message_time
        if silent <= self._timeout:
            return
        self.state = self.status()
        raise CameraLost(self._loss_reason(silent))

    def _await_frames_until(self, tick: float, patience: float) -> None:
        """Wait until all frames before a tick have arrived."""
        deadline = time.monotonic() + patience
        while self._until is None or self._until < tick - TIME_TOLERANCE_S:
            last_message_time = self._last_message_time
            wait = (
                min(_STATUS_PERIOD_S, max(0.0, deadline - time.monotonic()))
                if self._until
                else _POLL_PERIOD_S
            )
            self.poll(wait)
            if self._until is not None and self._until >= tick - TIME_TOLERANCE_S:
                return
            if self._last_message_time > last_message_time and time.monotonic() < deadline:
                continue
            state = self.status()
            self._follow(state)
            if state.until is None:
                return  # fishd has not completed a tick since the camera connected to it
            self._await_counted_frames(state, deadline)
            if self._session != state.session:
                continue
            # Messages published before this client subscribed will not arrive.
            self._until = max(self._until or 0.0, state.until)
            if self._until < tick - TIME_TOLERANCE_S and time.monotonic() >= deadline:
                raise CameraLost(
                    f"the camera at {self.endpoint} has no frames for the tick at {tick:.3f} s: it "
                    f"has come to {self._until:.3f} s and is {self.state.state}"
                    + self._camera_problem()
                )

    def _await_counted_frames(self, state: CameraState, deadline: float) -> None:
        """Wait for the frames that a state counts, because the answer may overtake them.

        The socket of the frames also carries the state twice a second, after all frames that the
        state counts.
        """
        while self._session == state.session and self._last_seq < state.seq:
            remaining = deadline - time.monotonic()
            if remaining <= 0.0:
                return
            self.poll(min(_POLL_PERIOD_S, remaining))

    def _loss_reason(self, silent: float) -> str:
        camera = f"the camera at {self.endpoint}"
        if self.state.state != "streaming":
            ago = max(0.0, self.state.t - self.state.since)
            return f"{camera} has been {self.state.state} for {ago:.0f} s" + self._camera_problem()
        if self._last_problem:
            return f"{camera} sends what cannot be used: {self._last_problem}"
        return (
            f"{camera} says that it streams, but no frame has come from {self.state.frames} for "
            f"{silent:.0f} s; can this machine reach that address?"
        )

    def _camera_problem(self) -> str:
        problem = "; ".join(filter(None, (self.state.problem, self.state.remedy)))
        return f": {text.line(problem)}" if problem else ""

    def _subscribe(self, address: str, topics: list[bytes]) -> None:
        def open_socket(address: str) -> "zmq.Socket[bytes]":
            socket = self._context.socket(zmq.SUB)
            socket.set(zmq.RCVHWM, MAX_QUEUED_MESSAGES)
            socket.set(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
            socket.set(zmq.RECONNECT_IVL, 20)
            socket.set(zmq.RECONNECT_IVL_MAX, 500)
            for topic in topics:
                socket.subscribe(topic)
            connect(socket, address)
            return socket

        source = f"the camera at {self.endpoint}"
        # `check` says that no frames arrive.
        self._subscription = Subscription(open_socket, address, source, lambda line: None)

    def _await_subscription(self) -> None:
        """Wait for the state that the camera sends to a new subscriber; raises `CameraLost`."""
        if not self._subscription.socket.poll(int(self._timeout * 1e3)):
            raise CameraLost(
                f"the camera at {self.endpoint} answers, but nothing comes from its frames at "
                f"{self.state.frames}; can this machine reach that address?"
            )

    def _receive_all(self) -> list[tuple[FrameHeader, Frame]]:
        frames: list[tuple[FrameHeader, Frame]] = []
        self._until_moved = False
        for _ in range(MAX_QUEUED_MESSAGES):
            try:
                parts = self._subscription.socket.recv_multipart(zmq.NOBLOCK)
                self._subscription.hear()
                message = messages.decode(parts)
            except zmq.Again:
                break
            except BadMessage as error:
                self._last_problem = str(error)
                continue
            if isinstance(message, PublishedFrame):
                if frame := self._store(message):
                    frames.append((message.header, frame))
            elif isinstance(message, PublishedView):
                self.view = message
            elif isinstance(message, TailMessage):
                self._store_tail(message)
            elif isinstance(message, Until):
                self._enter(message.session)
                self._until, self._until_moved = message.until, True
                self._last_message_time = time.monotonic()
            else:
                self._follow(message)
                self._last_seq = max(self._last_seq, message.seq)
        return frames

    def _store(self, published: PublishedFrame) -> Frame | None:
        """Store a frame; return None where its time on the clock of fishd is unknown."""
        header = published.header
        self._enter(header.session)
        if self.latest and self.latest.header.session == header.session:
            self.missed += max(0, header.seq - self.latest.header.seq - 1)
        self.latest = published
        self._last_seq = max(self._last_seq, header.seq)
        offset = self._seconds_to_add(header.virtual)
        if offset is None:
            return None
        self._last_message_time = time.monotonic()
        frame = Frame(header.time + offset, header.available + offset, published.pixels)
        self.history.add(frame)
        return frame

    def _store_tail(self, tail: TailMessage) -> None:
        self._enter(tail.session)
        virtual = self.latest.header.virtual if self.latest else self.state.virtual
        offset = self._seconds_to_add(virtual)
        if offset is not None:
            self._tails.append(replace(tail, time=tail.time + offset))

    def _seconds_to_add(self, virtual: bool) -> float | None:
        """Return the offset for times of the camera [s]; None where unknown.

        Raises `FishError` where a clock has never answered.
        """
        if virtual:
            return 0.0
        try:
            return self.offset().seconds
        except FishError as error:
            if not all(
                clock.has_answered for clock in (self._camera_clock, self._fishd_clock) if clock
            ):
                raise
            self._last_problem = str(error)
            return None

    def _follow(self, state: CameraState) -> None:
        self._enter(state.session)
        self.state = state

    def _enter(self, session: str) -> None:
        """Reset when the session is a new one, because the camera or its clock is another one."""
        if session != self._session:
            self._session = session
            self._until = None
            self._last_seq = 0
            self.history.clear()
            self._camera_clock.forget()
            if self._fishd_clock:
                self._fishd_clock.forget()

    def _read_clock(self, patience: float | None) -> Reading:
        state = self.requests.status(patience)
        if state.clock is None:
            raise CameraLost(
                f"the camera at {self.endpoint} does not tell its clock yet: it is {state.state}"
            )
        return Reading(state.clock, state.boot_id)
