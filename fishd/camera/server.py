"""The loop of `fishd-camera`: takes what the source has, publishes it, and answers requests."""

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from typing import Self

import zmq

from fishd.camera import messages, picture
from fishd.camera.messages import FrameHeader, Until, ViewHeader
from fishd.camera.monitor import Monitor
from fishd.camera.settings import CameraSettings, without_password
from fishd.camera.sockets import MAX_UNKNOWN_BYTES, Publisher, Requests
from fishd.camera.sources.base import Shot, Source, Timeline, Trouble
from fishd.core import text
from fishd.core.camera_frames import Pixels
from fishd.core.process.systemd_notify import SystemdNotifier

log = logging.getLogger(__name__)

STATE_PERIOD = 0.5
"""Time between two messages that tell the state [s]."""
HANGS = 10.0
"""A source that is silent for so long hangs [s]."""
GIVEN_UP = 30.0
"""From then on systemd's watchdog is not fed any more [s]."""
AGAIN = 1.0
"""A source that has failed begins anew after so long [s]."""
LEAVING = 2.0
"""How long the source may take to let go of its camera [s]."""
WARNING_PERIOD_S = 60.0
"""Shortest time between two warnings of subscribers that were disconnected [s]."""
_LOOK = 50
"""Longest time between two looks at the rest [ms]."""
_WAITING = 4096
"""What may wait from the source; frames beyond it are dropped."""


class Server:
    """A source in a thread of its own, and the sockets; use it as a context manager.

    It is the sink of its source: what that has waits in one queue, in its order.
    """

    def __init__(self, settings: CameraSettings, source: Source) -> None:
        self._settings = settings
        self._source = source
        self._queue: deque[Callable[[], None]] = deque()
        self._news = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._alive = time.monotonic()
        self._stopping = threading.Event()
        self._failure = ""
        """The latest error that nobody had expected."""
        self._sessions = 0
        self._next_view = self._next_state = self._next_warning = 0.0
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Listen; raises `StartupError`."""
        with ExitStack() as stack:
            stack.callback(os.close, self._news)
            self._publisher = Publisher(self._settings.publish.frames, stack)
            self._requests = Requests(self._settings.publish.requests, stack)
            self._notifier = SystemdNotifier()
            stack.callback(self._notifier.close)
            self._monitor = Monitor(self._settings, self._source.device, self._publisher.address)
            self._monitor.session = self._new_session()
            self._requests.operations = {
                "status": self._monitor.state,
                "config": lambda: without_password(self._settings),
            }
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Serve until `stopping`."""
        log.info(
            "a camera, %s: frames at %s, requests at %s",
            self._source.device,
            self._publisher.address,
            self._requests.address,
        )
        self._watch()
        thread = threading.Thread(target=self._run_source, name="source", daemon=True)
        thread.start()
        try:
            while not stopping():
                self._turn({source for source, _ in self._poller.poll(_LOOK)})
        finally:
            self._notifier.stopping()
            self._stopping.set()
            thread.join(LEAVING)

    def _watch(self) -> None:
        self._poller = zmq.Poller()
        for source in (self._publisher.socket, self._requests.socket, self._news):
            if source is not None:
                self._poller.register(source, zmq.POLLIN)

    def _renew_publisher(self, now: float) -> None:
        if not self._publisher.renew(now):
            return
        self._watch()
        if self._publisher.socket is None and now >= self._next_warning:
            self._next_warning = now + WARNING_PERIOD_S
            log.warning(
                "%s: all subscribers were disconnected, and may connect again: they had "
                "subscribed to more than %d kB of topics that are not published",
                self._publisher.address,
                MAX_UNKNOWN_BYTES // 1000,
            )

    def _turn(self, ready: set[object]) -> None:
        if self._news in ready:
            self._take()
        if self._requests.socket in ready:
            self._requests.answer()
        asked = self._publisher.socket in ready and self._publisher.take_subscriptions()
        now = time.monotonic()
        self._renew_publisher(now)
        silent = now - self._alive
        if silent > HANGS:
            self._tell(
                self._monitor.trouble(
                    Trouble(
                        "stalled",
                        f"{self._source.device} has not answered for {HANGS:g} s: it hangs",
                        "plug it in again; if that does not help, restart fishd-camera",
                    )
                ),
                only=True,
            )
        if silent < GIVEN_UP:
            self._notifier.ticked(now)
        if asked or now >= self._next_state:
            self._tell(False)

    def _run_source(self) -> None:
        """A driver or library that fails unexpectedly must not end the process: try again."""
        while not self._stopping.is_set():
            try:
                self._source.run(self, self._stopping.wait)
            except Exception as error:
                why = f"{self._source.device} cannot be used: {text.named(error)}"
                if str(error) != self._failure:
                    log.exception("%s", why)
                self._failure = str(error)
                self.trouble(Trouble("unusable", why, "the log of fishd-camera says where"))
                self._stopping.wait(AGAIN)

    # The sink: called by the source, in its thread.

    def begin(self, timeline: Timeline, degraded: tuple[str, ...] = ()) -> None:
        """Frames follow, in a new session."""
        self._pass_on(lambda: self._monitor.begin(self._new_session(), timeline, degraded))

    def put(self, shot: Shot) -> None:
        """Make a frame of it, and let that be published."""
        if len(self._queue) > _WAITING:
            self.lost(dropped=1)
            return
        turned = picture.turned(shot.picture, self._settings.picture)
        pixels = picture.frame(turned, self._settings.picture)
        shot = shot._replace(picture=turned)
        self._pass_on(lambda: self._publish(shot, pixels))

    def covered(self, until: float) -> None:
        """Tell until when there are frames."""
        self._pass_on(lambda: self._publish_until(until))

    def lost(self, dropped: int = 0, broken: int = 0) -> None:
        """Count them."""

        def count() -> None:
            self._monitor.dropped += dropped
            self._monitor.broken += broken

        self._pass_on(count)

    def trouble(self, trouble: Trouble) -> None:
        """Tell of it."""
        self._pass_on(lambda: self._tell(self._monitor.trouble(trouble), only=True))

    def alive(self) -> None:
        """Note that the source does not hang."""
        self._alive = time.monotonic()

    def _pass_on(self, job: Callable[[], None]) -> None:
        self.alive()
        self._queue.append(job)
        self._wake()

    def _wake(self) -> None:
        os.eventfd_write(self._news, 1)

    # In the thread of the sockets.

    def _take(self) -> None:
        os.eventfd_read(self._news)
        for _ in range(
            len(self._queue)
        ):  # what comes meanwhile waits until requests had their turn
            self._queue.popleft()()
        if self._queue:
            self._wake()

    def _publish(self, shot: Shot, pixels: Pixels) -> None:
        monitor = self._monitor
        news = monitor.frame(shot.time, shot.available, shot.exposure, shot.picture.shape)
        header = FrameHeader(
            session=monitor.session,
            seq=monitor.seq,
            time=shot.time,
            available=shot.available,
            exposure=shot.exposure,
            dropped=monitor.dropped,
            virtual=monitor.timeline.virtual,
            width=pixels.shape[1],
            height=pixels.shape[0],
        )
        self._publisher.send(messages.frame(header, pixels))
        self._show(shot)
        if news:
            self._tell(True)

    def _show(self, shot: Shot) -> None:
        """Publish a picture for people, if it is time for one and somebody wants it."""
        now, rate = time.monotonic(), self._settings.publish.view_rate
        if not rate or now < self._next_view or not self._publisher.views_wanted:
            return
        self._next_view = now + 1.0 / rate
        jpeg, width, height = picture.jpeg(shot.picture, self._settings.publish)
        _, crop = picture.cropped(shot.picture, self._settings.picture)
        header = ViewHeader(
            session=self._monitor.session,
            seq=self._monitor.seq,
            time=shot.time,
            width=width,
            height=height,
            crop=crop,
        )
        self._publisher.send(messages.view(header, jpeg))

    def _publish_until(self, until: float) -> None:
        self._monitor.until = until
        message = Until(session=self._monitor.session, until=until)
        self._publisher.send(messages.until(message))

    def _tell(self, news: bool, *, only: bool = False) -> None:
        """Publish the state; news: log it, too; only: do nothing unless it is news."""
        if only and not news:
            return
        if news:
            line = text.line(self._monitor.line)
            level = logging.INFO if self._monitor.condition == "streaming" else logging.WARNING
            log.log(level, "%s", line)
            self._notifier.status(line)
        self._next_state = time.monotonic() + STATE_PERIOD
        self._publisher.send(messages.state(self._monitor.state()))

    def _new_session(self) -> str:
        self._sessions += 1
        return f"{os.getpid()}-{time.time_ns() // 1_000_000:x}-{self._sessions}"
