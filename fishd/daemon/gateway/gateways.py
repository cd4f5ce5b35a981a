"""The gateways as fishd sees them: links to processes that are started again when they end or hang.

Each process answers heartbeats over its link. One that does not is killed by its parent, the fork
server, and a new one serves in its place; a fork server that does not is killed with its gateways.
"""

import asyncio
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial

import msgspec

from fishd.control.reporting import Reporter
from fishd.core import addresses
from fishd.core.errors import StartupError
from fishd.core.process import safe_path
from fishd.core.signals import Event, Status, Tick
from fishd.daemon.control_server import ControlServer
from fishd.daemon.gateway.link import (
    CONTROL,
    END,
    LONGEST,
    NOTICE,
    PING,
    PONG,
    READY,
    STARTED,
    TELEMETRY,
    kind_and_outcome,
    pair,
    published,
    start,
)

BEAT_S = 0.08
"""Time between two heartbeats [s]."""
MAX_UNANSWERED = {CONTROL: 4, TELEMETRY: 8}
"""Heartbeats in a row that a gateway may leave unanswered; then it hangs."""
MAX_STARTING = 25
"""Heartbeats during which a gateway may start; then it hangs."""
MAX_SERVER_STARTING = 750
"""Heartbeats during which the fork server may start: a busy Pi may take long to load Python."""
MIN_PERIOD_S = 0.05
"""Shortest time between two starts of a gateway [s]."""
MIN_FAILED_PERIOD_S = 0.25
"""The same where the one before has never served [s]."""
LIMIT_PAUSE_S = 0.3
"""Time without a gateway after one that has exceeded a limit [s]."""
MIN_SERVER_PERIOD_S = 1.0
"""Shortest time between two starts of the fork server [s]."""
RETURN = 1.0
"""Longest time for subscribers to connect again, once a gateway serves [s]."""
MAX_REPORT_DELAY_S = {CONTROL: 2.0, TELEMETRY: 30.0}
"""Time after which a restart is reported, even if the new gateway does not serve yet [s]."""
FAREWELL = 0.5
"""Longest time for a gateway to pass on the last messages, once it is to end [s]."""

# Memory that a flood took goes back to the system.
_ENVIRONMENT = {"MALLOC_ARENA_MAX": "2", "MALLOC_TRIM_THRESHOLD_": "1048576"}


class _Peer:
    """A process at the other end of a link; for the thread of the asyncio loop only."""

    def __init__(self, max_unanswered: int, max_starting: int) -> None:
        self._events = asyncio.get_running_loop()
        self._link: socket.socket | None = None
        self._serves = False
        self._unanswered = 0
        """Heartbeats since the latest sign of life."""
        self._max_unanswered, self._max_starting = max_unanswered, max_starting
        self._wanted = True
        self._reading = False

    def beat(self) -> None:
        """Send a heartbeat, or end the link to a process that left too many unanswered."""
        if self._link is None or not self._reading:  # an answer may wait unread
            return
        if self._unanswered >= (self._max_unanswered if self._serves else self._max_starting):
            self._lost(f"it left {self._unanswered} heartbeats unanswered")
            return
        self._unanswered += 1
        if self._serves:
            with suppress(OSError):  # full, or its end is noticed where it is read from
                self._link.send(PING)

    def _connect(self, ours: socket.socket) -> None:
        self._link = ours
        self._serves = False
        self._unanswered = 0
        self._listen(self._wanted)

    def _readable(self) -> None:
        assert self._link
        try:
            message = self._link.recv(2 * LONGEST)
        except BlockingIOError:
            return
        except OSError:
            message = b""
        if not message:
            self._lost("")
            return
        self._unanswered = 0
        if message == READY:
            self._serves = True
            self._ready()
        elif message != PONG:
            self._take(message)

    def _ready(self) -> None:
        """The process serves from now on."""

    def _take(self, message: bytes) -> None:
        raise NotImplementedError

    def _lost(self, why: str) -> None:
        """The process has ended; why: or why it is of no use any more."""
        raise NotImplementedError

    def _drop_link(self) -> None:
        if self._link is not None:
            self._listen(False)
            self._link.close()
            self._link = None

    def _listen(self, wanted: bool) -> None:
        if self._link is not None and wanted is not self._reading:
            if wanted:
                self._events.add_reader(self._link, self._readable)
            else:
                self._events.remove_reader(self._link)
            self._reading = wanted


class ForkServer(_Peer):
    """The parent of the gateways; started again when it ends or hangs, and they with it."""

    def __init__(self) -> None:
        """Start it; must be made inside a running asyncio loop. Raises `StartupError`."""
        super().__init__(MAX_UNANSWERED[TELEMETRY], MAX_SERVER_STARTING)
        self.gateways: dict[str, Gateway] = {}
        self._timer: asyncio.TimerHandle | None = None
        try:
            self._start()
        except OSError as error:
            raise StartupError(
                f"{sys.executable}: cannot be started for the gateways: {error.strerror}"
            ) from None

    @property
    def serves(self) -> bool:
        """Whether it has begun to fork gateways."""
        return self._serves

    def fork(self, kind: str, address: str, link: socket.socket, listener: socket.socket) -> None:
        """Ask for a gateway, in place of the one before it; raises OSError."""
        if self._link is None:
            raise ConnectionError
        socket.send_fds(self._link, [start(kind, address)], [link.fileno(), listener.fileno()])

    def close(self) -> None:
        """Kill it, and with it what is left of its gateways; may be called twice."""
        if self._timer:
            self._timer.cancel()
        self._drop_link()
        self._process.kill()
        self._process.wait()

    def _start(self) -> None:
        ours, theirs = pair()
        with theirs, ExitStack() as stack:
            stack.callback(ours.close)
            self._process = subprocess.Popen(
                safe_path.python("-m", "fishd.daemon.gateway", str(theirs.fileno())),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=os.environ | _ENVIRONMENT,
                start_new_session=True,  # a Ctrl-C in the terminal is for fishd alone
            )
            stack.pop_all()
        self._started = self._events.time()
        self._connect(ours)

    def _take(self, message: bytes) -> None:
        if message.startswith(STARTED):
            kind, outcome = kind_and_outcome(message)
            self.gateways[kind].started(outcome)

    def _lost(self, why: str) -> None:
        """Kill it, which ends its gateways as well."""
        self._drop_link()
        self._process.kill()
        for gateway in self.gateways.values():
            gateway.server_lost(f"the fork server of the gateways was lost: {why or 'it ended'}")
        pause = self._started + MIN_SERVER_PERIOD_S - self._events.time()
        self._timer = self._events.call_later(max(0.0, pause), self._start_again)

    def _start_again(self) -> None:
        """Start it, once the one before has ended."""
        try:
            if self._process.poll() is None:
                self._timer = self._events.call_later(0.2 * MIN_PERIOD_S, self._start_again)
                return
            self._start()
        except OSError:  # Python is being upgraded, perhaps
            self._timer = self._events.call_later(MIN_SERVER_PERIOD_S, self._start_again)


class Gateway(_Peer):
    """The link to the process of one socket."""

    def __init__(
        self, kind: str, listener: socket.socket, address: str, server: ForkServer
    ) -> None:
        """Start it; must be made inside a running asyncio loop.

        kind: TELEMETRY or CONTROL
        listener: what clients connect to; it stays open while the process is started again
        address: the ZeroMQ address of the listener
        """
        super().__init__(MAX_UNANSWERED[kind], MAX_STARTING)
        self.kind = kind
        self.address = address
        self.take: Callable[[bytes], None] = lambda message: None
        """Called with every message that comes, once `read` has let them in."""
        self.restarts = 0
        """Number of restarts."""
        self.lost = 0
        """Messages to it that were dropped."""
        self.on_restart: Callable[[str], None] = lambda why: None
        """Called once it was started again, or should have been, with the latest reason."""
        self._listener = listener
        self._server = server
        self._wanted = kind == TELEMETRY  # its only messages: that it serves, and why it ends
        self._why = ""
        self._notice = ""
        """Which limit the process has exceeded, by itself."""
        self._begun = 0.0
        """Time of the latest start [s]."""
        self._telling: asyncio.TimerHandle | None = None
        self._tell_by = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._ending: float | None = None
        """Time until which it may pass on the last messages, once it is to end [s]."""
        server.gateways[kind] = self
        self._start()

    def send(self, message: bytes) -> bool:
        """Send without waiting; False if the pipe is full: the message counts as lost.

        Messages without a process to take them are lost as well: no client waits for them there.
        """
        try:
            if self._link is None:
                raise ConnectionError
            self._link.send(message)
        except BlockingIOError:
            self.lost += 1
            return False
        except OSError:  # its end is noticed where it is read from
            self.lost += 1
        return True

    def read(self, wanted: bool) -> None:
        """Take messages, or let them wait in the link."""
        self._wanted = wanted
        self._listen(wanted)

    def end(self) -> None:
        """Let it pass on what it has, and end; may be called twice."""
        if self._ending is not None:
            return
        self._ending = time.monotonic() + FAREWELL
        for timer in (self._timer, self._telling):
            if timer:
                timer.cancel()
        self._listen(False)
        if self._link is not None:
            self.send(END)

    def close(self) -> None:
        """Wait until it has ended; may be called twice."""
        self.end()
        assert self._ending is not None
        while self._link is not None:
            left = self._ending - time.monotonic()
            if left <= 0.0 or not select.select([self._link], [], [], left)[0]:
                break
            try:
                ended = not self._link.recv(2 * LONGEST)
            except OSError:
                ended = True
            if ended:
                break
        self._drop_link()

    def beat(self) -> None:
        """Send a heartbeat; a gateway that waits for the fork server has not begun to start."""
        if self._serves or self._server.serves:
            super().beat()

    def started(self, outcome: str) -> None:
        """Take note of how the process before this one ended."""
        self._why = self._why or outcome

    def server_lost(self, why: str) -> None:
        """The fork server has ended, and with it the process."""
        if self._link is not None and self._ending is None:
            self._lost(why)

    def _start(self) -> None:
        """Raises OSError."""
        ours, theirs = pair()
        with theirs, ExitStack() as stack:
            stack.callback(ours.close)
            self._server.fork(self.kind, self.address, theirs, self._listener)
            stack.pop_all()
        self._begun = self._events.time()
        self._connect(ours)

    def _take(self, message: bytes) -> None:
        if message.startswith(NOTICE):
            self._notice = message[1:].decode(errors="replace")
        else:
            self.take(message)

    def _lost(self, why: str) -> None:
        period = MIN_PERIOD_S if self._serves else MIN_FAILED_PERIOD_S
        pause = LIMIT_PAUSE_S if self._notice else self._begun + period - self._events.time()
        self._drop_link()
        self._why = why or self._notice
        self._notice = ""
        if self._telling:  # subscribers are gone again
            self._tell_at(self._tell_by)
        self._timer = self._events.call_later(max(0.0, pause), self._start_again)

    def _start_again(self) -> None:
        try:
            self._start()
        except OSError:  # the fork server is being started, or has no room for the request
            self._timer = self._events.call_later(MIN_PERIOD_S, self._start_again)
            return
        self.restarts += 1
        if not self._telling:
            self._tell_by = self._events.time() + MAX_REPORT_DELAY_S[self.kind]
            self._tell_at(self._tell_by)

    def _ready(self) -> None:
        """Report a restart; one of telemetry when subscribers have had time to connect again."""
        if self._telling:
            pause = RETURN if self.kind == TELEMETRY else 0.0
            self._tell_at(min(self._tell_by, self._events.time() + pause))

    def _tell_at(self, when: float) -> None:
        if self._telling:
            self._telling.cancel()
        self._telling = self._events.call_at(when, self._tell)

    def _tell(self) -> None:
        self._telling = None
        self.on_restart(self._why or "its process ended")


class Gateways:
    """Listens at both addresses from now on, until `stack` is closed."""

    def __init__(self, control: str, telemetry: str, stack: ExitStack) -> None:
        """Must be made inside a running asyncio loop.

        control, telemetry: addresses, which must be `claimed`
        Raises `StartupError`.
        """
        self._events = asyncio.get_running_loop()
        self._server = ForkServer()
        stack.callback(self._server.close)
        self.control = _open(CONTROL, control, self._server, stack)
        self.telemetry = _open(TELEMETRY, telemetry, self._server, stack)
        stack.callback(self.control.end)  # so that both end at the same time
        self._beat()
        stack.callback(lambda: self._timer.cancel())

    def serve(self, server: ControlServer, reporter: Reporter) -> None:
        """Let requests come in and replies go out, and tell when a gateway was started again."""
        server.send, server.read = self.control.send, self.control.read
        self.control.take = server.take
        self.control.read(True)
        for gateway in (self.control, self.telemetry):
            gateway.on_restart = partial(_tell_restart, reporter, gateway.kind)

    def _beat(self) -> None:
        for peer in (self._server, self.control, self.telemetry):
            peer.beat()
        self._timer = self._events.call_later(BEAT_S, self._beat)

    def counters(self) -> dict[str, int]:
        """What was survived, since start."""
        return {
            "telemetry_lost": self.telemetry.lost,
            "telemetry_restarts": self.telemetry.restarts,
            "control_restarts": self.control.restarts,
        }


def _open(kind: str, address: str, server: ForkServer, stack: ExitStack) -> Gateway:
    listener = addresses.listen(address, f"{kind}.address", group=kind == CONTROL)
    stack.callback(listener.close)
    try:
        gateway = Gateway(kind, listener, addresses.served(address, listener), server)
    except OSError as error:
        raise StartupError(f"the gateway of {kind} cannot be started: {error.strerror}") from None
    stack.callback(gateway.close)
    return gateway


def _tell_restart(reporter: Reporter, kind: str, why: str) -> None:
    message = f"the gateway of {kind} was started again: {why}"
    reporter.event("gateway", message, "warning", gateway=kind)


class Telemetry:
    """Publishes ticks, events and status: a topic and one JSON object each, without waiting."""

    def __init__(self, send: Callable[[bytes], object]) -> None:
        """send: takes a message for the gateway, without waiting"""
        self._encode = msgspec.json.Encoder().encode
        self._send = send

    def tick(self, tick: Tick) -> None:
        """Publish on topic `tick`."""
        self._send(published(b"tick", self._encode(tick)))

    def event(self, event: Event) -> None:
        """Publish on topic `event`."""
        self._send(published(b"event", self._encode(event)))

    def status(self, status: Status) -> None:
        """Publish on topic `status`."""
        self._send(published(b"status", self._encode(status)))
