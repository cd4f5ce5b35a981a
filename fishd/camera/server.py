"""Main loop of `fishd-camera`: publish the frames of the source, and answer requests."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Self

import zmq
from msgspec.structs import replace

from fishd.camera import messages, picture
from fishd.camera.measuring import Measuring
from fishd.camera.messages import CameraState, FrameHeader, TailMessage, Until, ViewHeader
from fishd.camera.monitor import Monitor
from fishd.camera.settings import CameraSettings, without_password
from fishd.camera.sockets import Publisher, Requests
from fishd.camera.sources.base import Shot, Source, Timeline, Trouble
from fishd.camera.tail.lens import CannotUseLens, Lens
from fishd.core import text
from fishd.core.camera_frames import Pixels
from fishd.core.errors import Refused
from fishd.core.process.systemd_notify import SystemdNotifier

log = logging.getLogger(__name__)

STATE_PERIOD = 0.5
"""Time between two messages with the state [s]."""
SOURCE_TIMEOUT_S = 10.0
"""Time without a sign of life after which a source counts as hung [s]."""
WATCHDOG_TIMEOUT_S = 30.0
"""Time without a sign of life from the source after which systemd's watchdog is not fed [s]."""
RESTART_DELAY_S = 1.0
"""Delay before a source that has failed is started again [s]."""
STOP_TIMEOUT_S = 2.0
"""Longest wait for the source to release its camera [s]."""
_POLL_TIMEOUT_MS = 50
"""Longest wait for sockets between two checks of timers [ms]."""
_MAX_QUEUED_JOBS = 4096
"""Largest number of jobs from the source that wait; further frames are dropped."""


class Server:
    """Server of a source, which runs in a separate thread, and of the sockets; a context manager.

    It is the sink of its source: the calls of the source wait in one queue, in their order.
    """

    def __init__(self, settings: CameraSettings, source: Source, learned: Path) -> None:
        """learned: file of what was learned of the tail"""
        self._settings = settings
        self._source = source
        self._queue: deque[Callable[[], None]] = deque()
        self._job_event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._last_sign_of_life = time.monotonic()
        self._stopping = threading.Event()
        self._last_error = ""
        """Latest unexpected error of the source."""
        self._sessions = 0
        self._next_view = self._next_state = 0.0
        self._measuring = Measuring(settings, learned, self._publish_tail)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Listen; raises `StartupError`."""
        with ExitStack() as stack:
            stack.callback(os.close, self._job_event)
            self._publisher = Publisher(self._settings.publish.frames, stack)
            self._requests = Requests(self._settings.publish.requests, stack)
            self._notifier = SystemdNotifier()
            stack.callback(self._notifier.close)
            self._monitor = Monitor(self._settings, self._source.device, self._publisher.address)
            self._monitor.session = self._new_session()
            self._requests.operations = {
                "status": self._state,
                "config": lambda: without_password(self._settings),
                "learn_tail": partial(self._do, self._measuring.begin_learning),
                "finish_tail": partial(self._do, self._measuring.finish_learning),
                "cancel_tail": partial(self._do, self._measuring.cancel_learning),
                "lens": self._lens,
                "set_lens": partial(self._do, self._measuring.set_lens),
            }
            self._requests.arguments = {"set_lens": Lens}
            stack.enter_context(self._measuring)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Serve until `stopping` returns true."""
        log.info(
            "a camera, %s: frames at %s, requests at %s",
            self._source.device,
            self._publisher.address,
            self._requests.address,
        )
        self._register_sockets()
        thread = threading.Thread(target=self._run_source, name="source", daemon=True)
        thread.start()
        try:
            while not stopping():
                self._serve_ready({source for source, _ in self._poller.poll(_POLL_TIMEOUT_MS)})
        finally:
            self._notifier.stopping()
            self._stopping.set()
            thread.join(STOP_TIMEOUT_S)

    def _register_sockets(self) -> None:
        self._poller = zmq.Poller()
        for source in (self._publisher.socket, self._requests.socket, self._job_event):
            self._poller.register(source, zmq.POLLIN)

    def _serve_ready(self, ready: set[object]) -> None:
        if self._job_event in ready:
            self._run_jobs()
        if self._requests.socket in ready:
            self._requests.answer()
        state_requested = self._publisher.socket in ready and self._publisher.take_subscriptions()
        now = time.monotonic()
        silence = now - self._last_sign_of_life
        if silence > SOURCE_TIMEOUT_S:
            self._publish_state(
                self._monitor.trouble(
                    Trouble(
                        "stalled",
                        f"{self._source.device} has not answered for {SOURCE_TIMEOUT_S:g} s: "
                        "it hangs",
                        "plug it in again; if that does not help, restart fishd-camera",
                    )
                ),
                only_changes=True,
            )
        if silence < WATCHDOG_TIMEOUT_S:
            self._notifier.ticked(now)
        if now >= self._next_state:
            self._restore_files()
        if state_requested or now >= self._next_state:
            self._publish_state(False)

    def _restore_files(self) -> None:
        """Create files of sockets again that are gone, and restore their modes."""
        lines = []
        for server in (self._publisher, self._requests):
            before, restored = server.file.problem, server.file.restore()
            if restored:
                lines.append(f"the files of the socket {server.address} {restored}")
            elif (problem := server.file.problem) and problem != before:
                lines.append(f"clients cannot reach {server.address}: {problem}")
        if lines:
            self._register_sockets()
            log.warning("%s", "; ".join(lines))

    def _run_source(self) -> None:
        """Run the source, and again after an unexpected failure of a driver or library."""
        while not self._stopping.is_set():
            try:
                self._source.run(self, self._stopping.wait)
            except Exception as error:
                problem = f"{self._source.device} cannot be used: {text.describe_error(error)}"
                if str(error) != self._last_error:
                    log.exception("%s", problem)
                self._last_error = str(error)
                self.trouble(Trouble("unusable", problem, "the log of fishd-camera says where"))
                self._stopping.wait(RESTART_DELAY_S)

    # The sink: called by the source in its thread.

    def begin(self, timeline: Timeline, limitations: tuple[str, ...] = ()) -> None:
        """Start a new session."""
        self._enqueue(lambda: self._monitor.begin(self._new_session(), timeline, limitations))

    def put(self, shot: Shot) -> None:
        """Convert a shot to a frame, and queue it."""
        if len(self._queue) > _MAX_QUEUED_JOBS:
            self.lost(dropped=1)
            return
        turned = picture.rotate(shot.picture, self._settings.picture.rotate)
        pixels = picture.make_frame(turned, self._settings.picture)
        shot = shot._replace(picture=turned)
        self._enqueue(lambda: self._publish(shot, pixels))

    def covered(self, until: float) -> None:
        """Queue a message that all frames until a time have been put [s]."""
        self._enqueue(lambda: self._publish_until(until))

    def lost(self, dropped: int = 0, broken: int = 0) -> None:
        """Count lost frames."""

        def count() -> None:
            self._monitor.dropped += dropped
            self._monitor.broken += broken

        self._enqueue(count)

    def trouble(self, trouble: Trouble) -> None:
        """Queue a change to a condition without frames."""
        self._enqueue(
            lambda: self._publish_state(self._monitor.trouble(trouble), only_changes=True)
        )

    def alive(self) -> None:
        """Record a sign of life from the source."""
        self._last_sign_of_life = time.monotonic()

    def _enqueue(self, job: Callable[[], None]) -> None:
        self.alive()
        self._queue.append(job)
        self._wake()

    def _wake(self) -> None:
        os.eventfd_write(self._job_event, 1)

    def _publish_tail(self, tail: TailMessage) -> None:
        """Queue a fin angle; called in the thread that measures."""
        self._queue.append(lambda: self._publisher.send(messages.encode(tail)))
        self._wake()

    # The rest runs in the thread of the sockets.

    def _run_jobs(self) -> None:
        os.eventfd_read(self._job_event)
        for _ in range(len(self._queue)):  # later jobs wait until requests have been answered
            self._queue.popleft()()
        if self._queue:
            self._wake()

    def _publish(self, shot: Shot, pixels: Pixels) -> None:
        monitor = self._monitor
        changed = monitor.frame(shot.time, shot.available, shot.exposure, shot.picture.shape)
        header = FrameHeader(
            session=monitor.session,
            seq=monitor.seq,
            time=shot.time,
            available=shot.available,
            exposure=shot.exposure,
            dropped_frames=monitor.dropped,
            virtual=monitor.timeline.virtual,
            width=pixels.shape[1],
            height=pixels.shape[0],
        )
        self._publisher.send(messages.encode(header, pixels.tobytes()))
        self._measuring.offer(monitor.session, monitor.seq, shot.time, shot.picture)
        self._publish_view(shot)
        if changed:
            self._publish_state(True)

    def _publish_view(self, shot: Shot) -> None:
        """Publish a picture for people, if one is due and there is a subscriber."""
        now, rate = time.monotonic(), self._settings.publish.view_rate
        if not rate or now < self._next_view or not self._publisher.views_wanted:
            return
        self._next_view = now + 1.0 / rate
        jpeg, width, height = picture.encode_jpeg(shot.picture, self._settings.publish)
        _, crop = picture.crop(shot.picture, self._settings.picture)
        header = ViewHeader(
            session=self._monitor.session,
            seq=self._monitor.seq,
            time=shot.time,
            width=width,
            height=height,
            crop=crop,
        )
        self._publisher.send(messages.encode(header, jpeg))

    def _publish_until(self, until: float) -> None:
        self._monitor.until = until
        message = Until(session=self._monitor.session, until=until)
        self._publisher.send(messages.encode(message))

    def _publish_state(self, changed: bool, *, only_changes: bool = False) -> None:
        """Publish the state.

        changed: whether the condition has changed, which is logged
        only: publish nothing unless it has changed
        """
        if only_changes and not changed:
            return
        if changed:
            line = text.line(self._monitor.line)
            level = logging.INFO if self._monitor.condition == "streaming" else logging.WARNING
            log.log(level, "%s", line)
            self._notifier.status(line)
        self._next_state = time.monotonic() + STATE_PERIOD
        self._publisher.send(messages.encode(self._state()))

    def _lens(self) -> Lens:
        if self._measuring.lens is None:
            raise Refused("no-lens", "its lens is not calibrated: run 'fishctl camera lens'")
        return self._measuring.lens

    def _do(self, work: Callable[..., None], *values: object) -> CameraState:
        """Do the work of a request, and return the state."""
        try:
            work(*values)
        except CannotUseLens as error:
            raise Refused("bad-lens", text.error_message(error)) from None
        return self._state()

    def _state(self) -> CameraState:
        """Return the state of the camera, and of the measurement of the tail."""
        measuring, learned = self._measuring, self._measuring.learned
        return replace(
            self._monitor.state(),
            tail=measuring.condition,
            tail_problem=measuring.problem,
            tail_learned=learned.date if learned else "",
            tail_zero_ci95=learned.zero_ci95 if learned else None,
            lens=measuring.lens.describe() if measuring.lens else "",
            measured_pictures=measuring.measured,
            unmeasured_pictures=measuring.dropped,
        )

    def _new_session(self) -> str:
        self._sessions += 1
        return f"{os.getpid()}-{time.time_ns() // 1_000_000:x}-{self._sessions}"
