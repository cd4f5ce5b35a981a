"""Gateways from the side of fishd: links to processes that are replaced when they end or hang.

There is one for the sockets of this machine, and another one for clients with a key, so that no
program in the network disturbs the clients here.
"""

import asyncio
import logging
import os
import socket
import subprocess
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
from fishd.daemon.gateway import link
from fishd.daemon.gateway.link import CONTROL, TELEMETRY, join_frames

log = logging.getLogger(__name__)

MAX_UNANSWERED = 3
"""Number of unanswered heartbeats from which on a gateway counts as hung: long enough for one that
gets little time from a processor with a real-time task, once a second."""
MAX_STARTING = 120
"""Longest start of a gateway, in heartbeats: a busy Pi may take long to load Python."""
MIN_PERIOD_S = 1.0
"""Shortest time between two starts of a process [s]."""
RETRY_S = 0.01
"""Time until another look at a process that was killed and has not ended [s]."""
RECONNECT_TIME_S = 1.0
"""Time for subscribers to connect again after a gateway has started to serve [s]."""
END_TIMEOUT_S = 0.5
"""Longest time for a gateway to pass on the last messages before it ends [s]."""

# With these settings, memory that a flood used is returned to the system.
_ENVIRONMENT = {"MALLOC_ARENA_MAX": "2", "MALLOC_TRIM_THRESHOLD_": "1048576"}


class ListeningSocket:
    """Socket of a gateway. fishd keeps its listener, so that clients find it during a restart."""

    def __init__(self, gateway: "Gateway", kind: str, address: str, listener: socket.socket):
        self.kind, self.address = kind, address
        self._gateway, self._listener = gateway, listener

    def open(self) -> None:
        """Let the process of the gateway listen; raise OSError if that fails."""
        self._gateway.send_listener(self.kind, self.address, self._listener)

    def listen_at(self, address: str, listener: socket.socket) -> None:
        """Listen at another address, too; connections through the present one stay.

        Raise OSError if the process does not get it; nothing has changed then.
        """
        self._gateway.send_listener(self.kind, address, listener)
        former, self._listener = self._listener, listener.dup()
        former.close()
        self.address = address

    def close(self) -> None:
        """Close the listener; may be called twice."""
        self._listener.close()


class Gateway:
    """Process that owns two sockets; only for the thread of the asyncio loop."""

    def __init__(self, name: str, keys: str = "") -> None:
        """
        name: `local`, or `network` for clients with a key
        keys: secret key and folder of the keys; empty without keys
        """
        self.name = name
        self.take: Callable[[bytes], None] = lambda message: None
        """Function called with every request, after `read` has enabled them."""
        self.on_restart: Callable[[str], None] = lambda why: None
        """Function called with the latest reason after a restart."""
        self.wants_ticks = False
        """Whether a subscription matches ticks."""
        self.restarts = 0
        """Number of restarts."""
        self.lost = 0
        """Number of dropped messages to the process."""
        self._keys = keys
        self._sockets: list[ListeningSocket] = []
        self._events = asyncio.get_running_loop()
        self._link: socket.socket | None = None
        self._serves = False
        self._unanswered = 0
        """Heartbeats since the latest sign of life."""
        self._reading = self._may_read = False
        self._why = ""
        """Reason of a restart that is not reported yet."""
        self._started = 0.0
        """Time of the latest start of a process [s]."""
        self._timer: asyncio.TimerHandle | None = None
        self._report: asyncio.TimerHandle | None = None

    def listen(self, kind: str, address: str, key: str, stack: ExitStack) -> ListeningSocket:
        """Add a socket until `stack` is closed, before `start`; raise `StartupError`.

        address: address, which must be `claimed`; key: its key of the configuration, for messages
        """
        listener = addresses.listen(address, key, group=kind == CONTROL)
        where = addresses.reachable_address(address, listener)
        listening = ListeningSocket(self, kind, where, listener)
        stack.callback(listening.close)
        self._sockets.append(listening)
        return listening

    def start(self) -> None:
        """Start the process; raise OSError."""
        ours, theirs = link.pair()
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
        self._link, self._started = ours, self._events.time()
        self._begin()
        self._listen()

    def send_listener(self, kind: str, address: str, listener: socket.socket) -> None:
        """Let the process listen, or the next one if there is none now; raise OSError."""
        if self._link is not None:
            message = link.listen(kind, address, self._keys)
            socket.send_fds(self._link, [message], [listener.fileno()])

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

    def read(self, enabled: bool) -> None:
        """Read messages, or let them wait in the link."""
        self._may_read = enabled
        self._listen()

    def beat(self) -> None:
        """Send a heartbeat, or replace a process that hangs; call it twice a second."""
        if self._link is None or not self._reading:  # an answer may be waiting unread
            return
        if self._unanswered >= (MAX_UNANSWERED if self._serves else MAX_STARTING):
            self._handle_loss(f"it left {self._unanswered} heartbeats unanswered")
            return
        self._unanswered += 1
        if self._serves:
            with suppress(OSError):  # the link is full, or a read will notice the end
                self._link.send(link.PING)

    def end(self) -> None:
        """Let the process pass on its messages and end; may be called twice."""
        for timer in (self._timer, self._report):
            if timer:
                timer.cancel()
        self.read(False)
        if self._link is not None:
            with suppress(OSError):  # the process has ended
                self._link.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Wait until the process has ended, or kill it; may be called twice."""
        self.end()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(END_TIMEOUT_S)
        self._process.kill()
        self._process.wait()
        self._drop_link()

    def _begin(self) -> None:
        """Send the listeners to a process that begins, again perhaps."""
        self._serves = self.wants_ticks = False
        self._unanswered = 0
        self._open_all(CONTROL, TELEMETRY)

    def _open_all(self, *kinds: str) -> None:
        try:
            for listening in self._sockets:
                if listening.kind in kinds:
                    listening.open()
        except OSError:  # it has ended, or the link is full
            self._process.kill()  # a read will notice that

    def _read_message(self) -> None:
        assert self._link
        try:
            message = self._link.recv(2 * link.MAX_MESSAGE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            message = b""
        self._unanswered = 0
        if not message:
            self._handle_loss("")
        elif message.startswith(link.REQUEST):
            self.take(message)
        elif message.startswith(link.TICKS):
            self.wants_ticks = bool(message[1])
        elif message.startswith(link.READY):
            self._serves = True
            if self._why:
                self._report_soon()
        elif message.startswith((link.EXCEEDED, link.CLOSED)):
            self._why = message[1:].decode(errors="replace")
            self.restarts += 1
            if message.startswith(link.EXCEEDED):  # it starts again in the same process
                self._begin()
            else:
                self._open_all(TELEMETRY)
                self._report_soon()

    def _handle_loss(self, why: str) -> None:
        """Replace a process that has ended, or that hangs, as `why` says."""
        self._drop_link()
        self.wants_ticks = False
        self._process.kill()
        self._why = why
        pause = self._started + MIN_PERIOD_S - self._events.time()
        self._timer = self._events.call_later(max(0.0, pause), self._start_again)

    def _start_again(self) -> None:
        """Start a new process, after the one before has ended."""
        status = self._process.poll()
        if status is None:
            self._timer = self._events.call_later(RETRY_S, self._start_again)
            return
        self._why = self._why or f"its process ended with status {status}"
        try:
            self.start()
        except OSError as error:  # for example while Python is being upgraded
            log.warning("the gateway cannot be started: %s", error.strerror)
            self._timer = self._events.call_later(MIN_PERIOD_S, self._start_again)
        else:
            self.restarts += 1

    def _report_soon(self) -> None:
        """Report a restart when subscribers have had time to connect again."""
        if not self._report:
            self._report = self._events.call_later(RECONNECT_TIME_S, self._report_restart)

    def _report_restart(self) -> None:
        why = self._why or "its process ended"  # just now, again
        self._report, self._why = None, ""
        self.on_restart(why)

    def _drop_link(self) -> None:
        if self._link is not None:
            if self._reading:
                self._events.remove_reader(self._link)
                self._reading = False
            self._link.close()
            self._link = None

    def _listen(self) -> None:
        if self._link is not None and self._may_read is not self._reading:
            if self._may_read:
                self._events.add_reader(self._link, self._read_message)
            else:
                self._events.remove_reader(self._link)
            self._reading = self._may_read


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
        gateway = Gateway("local")
        self._gateways = [gateway]
        self.control = gateway.listen(CONTROL, control, "control.address", stack)
        self.telemetry = gateway.listen(TELEMETRY, telemetry, "telemetry.address", stack)
        self.keyed_telemetry = self.keyed_control = ""
        """Addresses for clients with a key; empty without keys."""
        if network:
            keyed = Gateway("network", read_keys(network.keys or ""))
            self._gateways.append(keyed)
            key = "network.control"
            self.keyed_control = keyed.listen(CONTROL, network.control, key, stack).address
            key = "network.telemetry"
            self.keyed_telemetry = keyed.listen(TELEMETRY, network.telemetry, key, stack).address
        for gateway in self._gateways:
            try:
                gateway.start()
            except OSError as error:
                raise StartupError(f"the gateway cannot be started: {error.strerror}") from None
            stack.callback(gateway.close)
        for gateway in self._gateways:
            stack.callback(gateway.end)  # so that all end at the same time

    @property
    def of_ticks(self) -> list[Gateway]:
        """Gateways that have a subscriber of ticks."""
        return [gateway for gateway in self._gateways if gateway.wants_ticks]

    def publish(self, message: bytes) -> None:
        """Send a message to all subscribers."""
        for gateway in self._gateways:
            gateway.send(message)

    def serve(self, server: ControlServer, reporter: Reporter) -> None:
        """Pass on requests and replies, and report when a gateway was started again."""
        server.read = self._read
        for gateway in self._gateways:
            gateway.take = partial(server.take, gateway.send)
            gateway.on_restart = partial(_report_event, reporter, gateway.name)
        self._read(True)

    def _read(self, enabled: bool) -> None:
        for gateway in self._gateways:
            gateway.read(enabled)

    def check(self) -> None:
        """Replace a process that hangs; call it twice a second."""
        for gateway in self._gateways:
            gateway.beat()

    def counters(self) -> dict[str, int]:
        """Return the numbers of recovered errors since start."""
        return {
            "telemetry_lost": sum(gateway.lost for gateway in self._gateways),
            "gateway_restarts": sum(gateway.restarts for gateway in self._gateways),
        }


def read_keys(name: str) -> str:
    """Return fishd's secret key and its folder; raise `ConfigError` for a wrong file there."""
    from fishd.core import keys

    folder = files.expand_user(name).absolute()
    secret = keys.read_secret(folder)
    _, mistakes = keys.read_known(folder)
    if mistakes:
        raise ConfigError(mistakes[0])
    return f"{secret} {folder}"


def _report_event(reporter: Reporter, name: str, why: str) -> None:
    message = f"the {name} gateway was started again: {why}"
    reporter.event("gateway", message, "warning", gateway=name)


class Telemetry:
    """Publisher of ticks, events and status: a topic and one JSON object each, without waiting."""

    def __init__(self, gateways: Gateways) -> None:
        self._encode = msgspec.json.Encoder().encode
        self._gateways = gateways

    def tick(self, tick: Tick) -> None:
        """Publish a tick on topic `tick`, if there is a subscriber."""
        if gateways := self._gateways.of_ticks:
            message = join_frames(b"tick", self._encode(tick))
            for gateway in gateways:
                gateway.send(message)

    def event(self, event: Event) -> None:
        """Publish an event on topic `event`."""
        self._gateways.publish(join_frames(b"event", self._encode(event)))

    def status(self, status: Status) -> None:
        """Publish a status on topic `status`."""
        self._gateways.publish(join_frames(b"status", self._encode(status)))
