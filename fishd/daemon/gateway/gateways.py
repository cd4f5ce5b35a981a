"""Gateways from the side of fishd: links to processes that are restarted when they end or hang.

Each process answers heartbeats over its link. A gateway that does not is killed by its parent, the
fork server, and replaced; a fork server that does not is killed together with its gateways. A
process that does not answer because it gets no processor time is kept.
"""

import asyncio
import logging
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

from fishd.config.configuration import NetworkSettings
from fishd.control.reporting import Reporter
from fishd.core import addresses, files
from fishd.core.errors import ConfigError, StartupError
from fishd.core.process import safe_path
from fishd.core.signals import Event, Status, Tick
from fishd.daemon.control_server import ControlServer
from fishd.daemon.gateway.link import (
    CONTROL,
    END,
    KEYED_CONTROL,
    KEYED_TELEMETRY,
    LISTEN,
    MAX_MESSAGE_BYTES,
    NOTICE,
    PING,
    PONG,
    READY,
    STARTED,
    TELEMETRY,
    join_frames,
    pair,
    read_started,
    start,
)
from fishd.daemon.gateway.starvation import Thread, is_starved, read_threads

log = logging.getLogger(__name__)

TELEMETRIES = {TELEMETRY, KEYED_TELEMETRY}

BEAT_S = 0.08
"""Time between two heartbeats [s]."""
MAX_UNANSWERED = {CONTROL: 4, TELEMETRY: 8, KEYED_CONTROL: 4, KEYED_TELEMETRY: 8}
"""Number of unanswered heartbeats in a row from which on a gateway counts as hung."""
MAX_STARTING = 25
"""Longest start of a gateway, in heartbeats; after that it counts as hung."""
MAX_SERVER_STARTING = 750
"""Longest start of the fork server, in heartbeats: a busy Pi may take long to load Python."""
MAX_STARVED = 125
"""Number of unanswered heartbeats in a row from which on a process is killed even if it got no
processor time."""
ANSWER_FRACTION = 0.25
"""Fraction of the permitted time after which a process that computes could have answered."""
MIN_PERIOD_S = 0.05
"""Shortest time between two starts of a gateway [s]."""
MIN_FAILED_PERIOD_S = 0.25
"""Shortest time between two starts of a gateway if the first never served [s]."""
LIMIT_PAUSE_S = 0.3
"""Time until the next start after a gateway that has exceeded a limit [s]."""
MIN_SERVER_PERIOD_S = 1.0
"""Shortest time between two starts of the fork server [s]."""
RECONNECT_TIME_S = 1.0
"""Time for subscribers to connect again after a gateway has started to serve [s]."""
MAX_REPORT_DELAY_S = {CONTROL: 2.0, TELEMETRY: 30.0, KEYED_CONTROL: 2.0, KEYED_TELEMETRY: 30.0}
"""Time after which a restart is reported, even if the new gateway does not serve yet [s]."""
END_TIMEOUT_S = 0.5
"""Longest time for a gateway to pass on the last messages before it ends [s]."""

# With these settings, memory that a flood used is returned to the system.
_ENVIRONMENT = {"MALLOC_ARENA_MAX": "2", "MALLOC_TRIM_THRESHOLD_": "1048576"}


class _Peer:
    """Process at the other end of a link; only for the thread of the asyncio loop."""

    def __init__(self, name: str, max_unanswered: int, max_starting: int) -> None:
        self._name = name
        self._events = asyncio.get_running_loop()
        self._link: socket.socket | None = None
        self._serves = False
        self._unanswered = 0
        """Heartbeats since the latest sign of life."""
        self._max_unanswered, self._max_starting = max_unanswered, max_starting
        self._threads: list[Thread] = []
        """Threads of the process when an answer was first missed."""
        self._was_starved = False
        self._enabled = True
        self._reading = False

    def beat(self) -> None:
        """Send a heartbeat, or close the link to a process that hangs."""
        if self._link is None or not self._reading:  # an answer may be waiting unread
            return
        permitted = self._max_unanswered if self._serves else self._max_starting
        if self._unanswered == 1:
            self._threads = read_threads(self._pid())
        elif self._unanswered >= permitted and self._hangs(permitted):
            self._handle_loss(f"it left {self._unanswered} heartbeats unanswered")
            return
        self._unanswered += 1
        if self._serves and self._unanswered <= permitted:
            with suppress(
                OSError
            ):  # the link is full, or a read will notice the end of the process
                self._link.send(PING)

    def _hangs(self, permitted: int) -> bool:
        """Return whether the process had a chance to answer; log once that it had none."""
        assert self._link
        if self._unanswered >= max(permitted, MAX_STARVED):
            return True
        answer_s = ANSWER_FRACTION * permitted * BEAT_S
        if not is_starved(self._threads, read_threads(self._pid()), answer_s):
            # It may have answered just now, before it fell asleep.
            return not select.select([self._link], [], [], 0.0)[0]
        if not self._was_starved:
            self._was_starved = True
            log.warning(
                "%s gets no processor time on this busy machine; fishd waits for it for up to %g s",
                self._name,
                MAX_STARVED * BEAT_S,
            )
        return False

    def _pid(self) -> int:
        """Return the number of the process that is to answer."""
        raise NotImplementedError

    def _connect(self, ours: socket.socket) -> None:
        self._link = ours
        self._serves = False
        self._unanswered = 0
        self._was_starved = False
        self._listen(self._enabled)

    def _read_message(self) -> None:
        assert self._link
        try:
            message = self._link.recv(2 * MAX_MESSAGE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            message = b""
        if not message:
            self._handle_loss("")
            return
        self._unanswered = 0
        if message.startswith(READY):
            self._serves = True
            self._handle_ready(message[1:].decode(errors="replace"))
        elif message != PONG:
            self._take(message)

    def _handle_ready(self, mistake: str) -> None:
        """Handle the message that the process has started to serve, in spite of a mistake."""

    def _take(self, message: bytes) -> None:
        raise NotImplementedError

    def _handle_loss(self, why: str) -> None:
        """Handle the end of the process, or an error that `why` describes."""
        raise NotImplementedError

    def _drop_link(self) -> None:
        if self._link is not None:
            self._listen(False)
            self._link.close()
            self._link = None

    def _listen(self, enabled: bool) -> None:
        if self._link is not None and enabled is not self._reading:
            if enabled:
                self._events.add_reader(self._link, self._read_message)
            else:
                self._events.remove_reader(self._link)
            self._reading = enabled


class ForkServer(_Peer):
    """Parent of the gateways; when it ends or hangs, it and they are started again."""

    def __init__(self) -> None:
        """Start the process; must be called in a running asyncio loop. Raises `StartupError`."""
        super().__init__(
            "the fork server of the gateways", MAX_UNANSWERED[TELEMETRY], MAX_SERVER_STARTING
        )
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
        """Whether it has started to serve."""
        return self._serves

    def fork(self, kind: str, address: str, link: socket.socket, listener: socket.socket) -> None:
        """Request a gateway that replaces the one before it; raise OSError if that fails."""
        if self._link is None:
            raise ConnectionError
        socket.send_fds(self._link, [start(kind, address)], [link.fileno(), listener.fileno()])

    def close(self) -> None:
        """Kill the process and with it its remaining gateways; may be called twice."""
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
                safe_path.python_command("-m", "fishd.daemon.gateway", str(theirs.fileno())),
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=os.environ | _ENVIRONMENT,
                start_new_session=True,  # a Ctrl-C in the terminal must reach only fishd
            )
            stack.pop_all()
        self._started = self._events.time()
        self._connect(ours)

    def _take(self, message: bytes) -> None:
        if message.startswith(STARTED):
            kind, pid, outcome = read_started(message)
            self.gateways[kind].started(pid, outcome)

    def _pid(self) -> int:
        return self._process.pid

    def _handle_loss(self, why: str) -> None:
        """Kill the process, which also ends its gateways, and start it again later."""
        self._drop_link()
        self._process.kill()
        for gateway in self.gateways.values():
            gateway.server_lost(f"the fork server of the gateways was lost: {why or 'it ended'}")
        pause = self._started + MIN_SERVER_PERIOD_S - self._events.time()
        self._timer = self._events.call_later(max(0.0, pause), self._start_again)

    def _start_again(self) -> None:
        """Start a new process, after the one before has ended."""
        try:
            if self._process.poll() is None:
                self._timer = self._events.call_later(0.2 * MIN_PERIOD_S, self._start_again)
                return
            self._start()
        except OSError:  # for example while Python is being upgraded
            self._timer = self._events.call_later(MIN_SERVER_PERIOD_S, self._start_again)


class Gateway(_Peer):
    """Link to the process of one socket."""

    def __init__(
        self, kind: str, listener: socket.socket, address: str, server: ForkServer, keys: str = ""
    ) -> None:
        """Start the process; must be called in a running asyncio loop.

        kind: TELEMETRY or CONTROL, or the same with keys
        listener: socket that clients connect to; it stays open during restarts of the process,
            and `close` closes it
        address: ZeroMQ address of the listener
        keys: secret key and folder of the keys, for a kind with keys
        """
        name = f"the gateway of {kind.replace('-', ' ')}"
        super().__init__(name, MAX_UNANSWERED[kind], MAX_STARTING)
        self.kind = kind
        self.address = address
        self.take: Callable[[bytes], None] = lambda message: None
        """Function called with every message, after `read` has enabled them."""
        self.restarts = 0
        """Number of restarts."""
        self.lost = 0
        """Number of dropped messages to the process."""
        self.on_restart: Callable[[str], None] = lambda why: None
        """Function called with the latest reason after a restart, or after its deadline."""
        self._listener = listener
        self._server = server
        self._keys = keys
        self._enabled = kind in TELEMETRIES  # it sends only that it serves, and why it ends
        self._why = ""
        self._number = 0
        """Number of the process; 0 until the fork server has started it."""
        self._notice = ""
        """Limit that the process says it has exceeded."""
        self._mistake = ""
        """Mistake in the file of known keys when the process started; empty without one."""
        self._started_at = 0.0
        """Time of the latest start [s]."""
        self._report_timer: asyncio.TimerHandle | None = None
        self._report_deadline = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._ending: float | None = None
        """Time until which it may pass on the last messages before it ends [s, monotonic]."""
        server.gateways[kind] = self
        self._start()

    def send(self, message: bytes) -> bool:
        """Send a message without waiting; return False if the link is full and the message lost.

        Without a process, messages are lost too: then no client waits for them.
        """
        try:
            if self._link is None:
                raise ConnectionError
            self._link.send(message)
        except BlockingIOError:
            self.lost += 1
            return False
        except OSError:  # a read will notice the end of the process
            self.lost += 1
        return True

    def listen_at(self, address: str, listener: socket.socket) -> None:
        """Listen at another address, too; connections through the present one stay.

        Raise OSError if the process could not be told; nothing has changed then.
        """
        if self._link is not None:  # else the next process gets the listener when it starts
            socket.send_fds(self._link, [LISTEN + address.encode()], [listener.fileno()])
        former, self._listener = self._listener, listener.dup()
        former.close()
        self.address = address

    def read(self, enabled: bool) -> None:
        """Read messages, or let them wait in the link."""
        self._enabled = enabled
        self._listen(enabled)

    def end(self) -> None:
        """Let the process pass on its messages and end; may be called twice."""
        if self._ending is not None:
            return
        self._ending = time.monotonic() + END_TIMEOUT_S
        for timer in (self._timer, self._report_timer):
            if timer:
                timer.cancel()
        self._listen(False)
        if self._link is not None:
            self.send(END)

    def close(self) -> None:
        """Wait until the process has ended; may be called twice."""
        self.end()
        assert self._ending is not None
        while self._link is not None:
            remaining = self._ending - time.monotonic()
            if remaining <= 0.0 or not select.select([self._link], [], [], remaining)[0]:
                break
            try:
                ended = not self._link.recv(2 * MAX_MESSAGE_BYTES)
            except OSError:
                ended = True
            if ended:
                break
        self._drop_link()
        self._listener.close()

    def beat(self) -> None:
        """Send a heartbeat, unless the gateway still waits for the fork server."""
        if self._serves or self._server.serves:
            super().beat()

    def started(self, pid: int, outcome: str) -> None:
        """Store the number of the process, and how the one before it ended."""
        self._number = pid
        self._threads = read_threads(pid)
        self._why = self._why or outcome

    def server_lost(self, why: str) -> None:
        """Handle the end of the fork server, and with it of the process."""
        if self._link is not None and self._ending is None:
            self._handle_loss(why)

    def _start(self) -> None:
        """Request a new process; raise OSError if that fails."""
        ours, theirs = pair()
        with theirs, ExitStack() as stack:
            stack.callback(ours.close)
            where = f"{self.address} {self._keys}".rstrip()
            self._server.fork(self.kind, where, theirs, self._listener)
            stack.pop_all()
        self._started_at = self._events.time()
        self._number = 0
        self._connect(ours)

    def _pid(self) -> int:
        return self._number or self._server._pid()

    def _take(self, message: bytes) -> None:
        if message.startswith(NOTICE):
            self._notice = message[1:].decode(errors="replace")
        else:
            self.take(message)

    def _handle_loss(self, why: str) -> None:
        period = MIN_PERIOD_S if self._serves else MIN_FAILED_PERIOD_S
        pause = LIMIT_PAUSE_S if self._notice else self._started_at + period - self._events.time()
        self._drop_link()
        self._why = why or self._notice
        self._notice = ""
        if self._report_timer:  # subscribers have lost their connections again
            self._report_at(self._report_deadline)
        self._timer = self._events.call_later(max(0.0, pause), self._start_again)

    def _start_again(self) -> None:
        try:
            self._start()
        except OSError:  # the fork server is starting, or its link is full
            self._timer = self._events.call_later(MIN_PERIOD_S, self._start_again)
            return
        self.restarts += 1
        if not self._report_timer:
            self._report_deadline = self._events.time() + MAX_REPORT_DELAY_S[self.kind]
            self._report_at(self._report_deadline)

    def _handle_ready(self, mistake: str) -> None:
        """Report a restart; of telemetry, when subscribers have had time to connect again."""
        self._mistake = mistake
        if self._report_timer:
            pause = RECONNECT_TIME_S if self.kind in TELEMETRIES else 0.0
            self._report_at(min(self._report_deadline, self._events.time() + pause))

    def _report_at(self, when: float) -> None:
        if self._report_timer:
            self._report_timer.cancel()
        self._report_timer = self._events.call_at(when, self._report_restart)

    def _report_restart(self) -> None:
        self._report_timer = None
        why = self._why or "its process ended"
        self.on_restart(why if self._mistake in why else f"{why}; {self._mistake}")


class Gateways:
    """All gateways, which listen at their addresses until `stack` is closed."""

    def __init__(
        self, control: str, telemetry: str, stack: ExitStack, network: NetworkSettings | None = None
    ) -> None:
        """Start the gateways; must be called in a running asyncio loop.

        control, telemetry: addresses, which must be `claimed`
        network: settings of the access over the network; None for no such access
        Raises `StartupError`, and `ConfigError` for a file of keys.
        """
        self._events = asyncio.get_running_loop()
        keys = _read_keys(network.keys or "") if network else ""
        self._server = ForkServer()
        stack.callback(self._server.close)
        self.control = _open(CONTROL, control, self._server, stack)
        self.telemetry = _open(TELEMETRY, telemetry, self._server, stack)
        self._controls, self._telemetries = [self.control], [self.telemetry]
        self.keyed_telemetry = self.keyed_control = ""
        """Addresses for clients with a key; empty without keys."""
        if network:
            for kind, address, gateways in (
                (KEYED_CONTROL, network.control, self._controls),
                (KEYED_TELEMETRY, network.telemetry, self._telemetries),
            ):
                gateways.append(_open(kind, address, self._server, stack, keys))
            self.keyed_control = self._controls[-1].address
            self.keyed_telemetry = self._telemetries[-1].address
        for gateway in (*self._controls, *self._telemetries):
            stack.callback(gateway.end)  # so that all end at the same time
        self._peers = (self._server, *self._controls, *self._telemetries)
        self._beat()
        stack.callback(lambda: self._timer.cancel())

    @property
    def publish(self) -> Callable[[bytes], object]:
        """Function that sends a message to all subscribers."""
        return self._publish if self.keyed_telemetry else self.telemetry.send

    def _publish(self, message: bytes) -> None:
        for gateway in self._telemetries:
            gateway.send(message)

    def serve(self, server: ControlServer, reporter: Reporter) -> None:
        """Pass on requests and replies, and report when a gateway was started again."""
        server.read = self._read
        for gateway in self._controls:
            gateway.take = partial(server.take, gateway.send)
        self._read(True)
        for gateway in (*self._controls, *self._telemetries):
            gateway.on_restart = partial(_report_event, reporter, gateway.kind)

    def _read(self, enabled: bool) -> None:
        for gateway in self._controls:
            gateway.read(enabled)

    def _beat(self) -> None:
        for peer in self._peers:
            peer.beat()
        self._timer = self._events.call_later(BEAT_S, self._beat)

    def counters(self) -> dict[str, int]:
        """Return the numbers of recovered errors since start."""
        return {
            "telemetry_lost": sum(gateway.lost for gateway in self._telemetries),
            "telemetry_restarts": sum(gateway.restarts for gateway in self._telemetries),
            "control_restarts": sum(gateway.restarts for gateway in self._controls),
        }


def _open(kind: str, address: str, server: ForkServer, stack: ExitStack, keys: str = "") -> Gateway:
    key = kind.replace("keyed-", "network.") if keys else f"{kind}.address"
    listener = addresses.listen(address, key, group=kind == CONTROL)
    where = addresses.reachable_address(address, listener)
    try:
        gateway = Gateway(kind, listener, where, server, keys)
    except OSError as error:
        listener.close()
        raise StartupError(f"the gateway of {kind} cannot be started: {error.strerror}") from None
    stack.callback(gateway.close)
    return gateway


def _read_keys(name: str) -> str:
    """Return fishd's secret key and its folder; raise `ConfigError` for a wrong file there."""
    from fishd.core import keys

    folder = files.expand_user(name).absolute()
    secret = keys.read_secret(folder)
    _, mistakes = keys.read_known(folder)
    if mistakes:
        raise ConfigError(mistakes[0])
    return f"{secret} {folder}"


def _report_event(reporter: Reporter, kind: str, why: str) -> None:
    message = f"the gateway of {kind.replace('-', ' ')} was started again: {why}"
    reporter.event("gateway", message, "warning", gateway=kind)


class Telemetry:
    """Publisher of ticks, events and status: a topic and one JSON object each, without waiting."""

    def __init__(self, send: Callable[[bytes], object]) -> None:
        """send: function that sends a message to the gateway without waiting"""
        self._encode = msgspec.json.Encoder().encode
        self._send = send

    def tick(self, tick: Tick) -> None:
        """Publish a tick on topic `tick`."""
        self._send(join_frames(b"tick", self._encode(tick)))

    def event(self, event: Event) -> None:
        """Publish an event on topic `event`."""
        self._send(join_frames(b"event", self._encode(event)))

    def status(self, status: Status) -> None:
        """Publish a status on topic `status`."""
        self._send(join_frames(b"status", self._encode(status)))
