"""The gateways as fishd sees them: processes that are started again when they end, and links."""

import asyncio
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

import msgspec

from fishd.control.reporting import Reporter
from fishd.core import addresses
from fishd.core.errors import StartupError
from fishd.core.signals import Event, Status, Tick
from fishd.daemon.control_server import ControlServer
from fishd.daemon.gateway.link import (
    CONTROL,
    END,
    LONGEST,
    NOTICE,
    READY,
    TELEMETRY,
    pair,
    published,
)

PAUSES = 0.05, 2.0
"""Shortest and longest pause before a gateway is started again [s]."""
HEALTHY = 10.0
"""A gateway that ran for so long is started again after the shortest pause [s]."""
RETURN = 1.0
"""How long clients may take to connect again, once a gateway serves [s]."""
START = 30.0
"""After this time a restart is reported, even if the new gateway does not serve yet [s]."""
FAREWELL = 0.5
"""How long it may take to pass on the last messages from when it is told to end [s]."""

# Memory that a flood took goes back to the system.
_ENVIRONMENT = {"MALLOC_ARENA_MAX": "2", "MALLOC_TRIM_THRESHOLD_": "1048576"}


class Gateway:
    """The process of one socket and the link to it; for the thread of the asyncio loop only."""

    def __init__(self, kind: str, listener: socket.socket, address: str) -> None:
        """Start it; must be made inside a running asyncio loop.

        kind: TELEMETRY or CONTROL
        listener: what clients connect to; it stays open while the process is started again
        address: the ZeroMQ address of the listener
        Raises `StartupError`.
        """
        self.kind = kind
        self.address = address
        self.take: Callable[[bytes], None] = lambda message: None
        """Called with every message that comes, once `read` was told to take them."""
        self.restarts = 0
        """How often it was started again."""
        self.lost = 0
        """Messages to it that were dropped."""
        self.on_restart: Callable[[str], None] = lambda why: None
        """Called once it was started again, or should have been, with the latest reason."""
        self._listener = listener
        self._events = asyncio.get_running_loop()
        self._link: socket.socket | None = None
        self._wanted = kind == TELEMETRY  # its only messages: that it serves, and why it ends
        self._reading = False
        self._pause = PAUSES[0]
        self._why = ""
        self._telling: asyncio.TimerHandle | None = None
        self._tell_by = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False
        try:
            self._start()
        except OSError as error:
            raise StartupError(
                f"{sys.executable}: cannot be started for the gateway of {kind}: {error.strerror}"
            ) from None

    def send(self, message: bytes) -> bool:
        """Send without waiting; False if the pipe is full: the message counts as lost.

        What is sent while there is no process is lost as well: nobody waits for it there.
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
        if self._closed:
            return
        self._closed = True
        self._farewell = time.monotonic() + FAREWELL
        for timer in (self._timer, self._telling):
            if timer:
                timer.cancel()
        if self._link is not None:
            self.send(END)
            self._drop_link()

    def close(self) -> None:
        """Wait until it has ended; may be called twice."""
        self.end()
        try:
            self._process.wait(max(0.0, self._farewell - time.monotonic()))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _start(self) -> None:
        """Raises OSError."""
        ours, theirs = pair()
        with theirs, ExitStack() as stack:
            stack.callback(ours.close)
            numbers = [theirs.fileno(), self._listener.fileno()]
            self._process = subprocess.Popen(
                # -P: not what lies in the working directory.
                [sys.executable, "-P", "-m", "fishd.daemon.gateway", self.kind]
                + [str(number) for number in numbers]
                + [self.address],
                pass_fds=numbers,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=os.environ | _ENVIRONMENT,
                start_new_session=True,  # a Ctrl-C in the terminal is for fishd alone
            )
            stack.pop_all()
        self._link = ours
        self._started = self._events.time()
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
            self._ended()
        elif message == READY:
            self._serves()
        elif message.startswith(NOTICE):
            self._tell(message[1:].decode(errors="replace"))
        else:
            self.take(message)

    def _ended(self) -> None:
        self._drop_link()
        if self._telling:  # nobody would hear it now
            self._tell_at(self._tell_by)
        lived = self._events.time() - self._started
        self._pause = PAUSES[0] if lived > HEALTHY else min(2.0 * self._pause, PAUSES[1])
        self._timer = self._events.call_later(self._pause, self._start_again)

    def _start_again(self) -> None:
        status = self._process.poll()
        if status is None:  # its link is gone, so it is of no use
            self._process.kill()
            self._timer = self._events.call_later(PAUSES[0], self._start_again)
            return
        try:
            self._start()
            self._tell(f"its process ended with status {status}")
        except OSError as error:  # Python was renewed, say, and is not there just now
            self._tell(f"it cannot be started: {error.strerror}", RETURN)
            self._pause = PAUSES[1]
            self._timer = self._events.call_later(self._pause, self._start_again)

    def _tell(self, why: str, within: float = START) -> None:
        """Count a restart, and report it once subscribers are back, or `within` so long [s]."""
        self.restarts += 1
        self._why = why
        if self._telling is None:
            self._tell_by = self._events.time() + within
        self._tell_at(self._tell_by)

    def _serves(self) -> None:
        """From now on subscribers can come back, and hear of the restart then."""
        if self._telling:
            self._tell_at(min(self._tell_by, self._events.time() + RETURN))

    def _tell_at(self, when: float) -> None:
        if self._telling:
            self._telling.cancel()
        self._telling = self._events.call_at(when, self._told)

    def _told(self) -> None:
        self._telling = None
        self.on_restart(self._why)

    def _drop_link(self) -> None:
        assert self._link
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


class Gateways:
    """Listens at both addresses from now on, until `stack` is closed."""

    def __init__(self, control: str, telemetry: str, stack: ExitStack) -> None:
        """Must be made inside a running asyncio loop.

        control, telemetry: addresses, which must be `claimed`
        Raises `StartupError`.
        """
        self.control = _open(CONTROL, control, stack)
        self.telemetry = _open(TELEMETRY, telemetry, stack)
        stack.callback(self.control.end)  # so that both end at the same time

    def serve(self, server: ControlServer, reporter: Reporter) -> None:
        """Let requests come in and replies go out, and tell when a gateway was started again."""
        server.send, server.read = self.control.send, self.control.read
        self.control.take = server.take
        self.control.read(True)
        for gateway in (self.control, self.telemetry):
            gateway.on_restart = partial(_tell_restart, reporter, gateway.kind)

    def counters(self) -> dict[str, int]:
        """What was survived, since start."""
        return {
            "telemetry_lost": self.telemetry.lost,
            "telemetry_restarts": self.telemetry.restarts,
            "control_restarts": self.control.restarts,
        }


def _open(kind: str, address: str, stack: ExitStack) -> Gateway:
    listener = addresses.listen(address, f"{kind}.address", group=kind == CONTROL)
    stack.callback(listener.close)
    gateway = Gateway(kind, listener, addresses.served(address, listener))
    stack.callback(gateway.close)
    return gateway


def _tell_restart(reporter: Reporter, kind: str, why: str) -> None:
    message = f"the gateway of {kind} was started again: {why}"
    reporter.event("gateway", message, "warning", gateway=kind)


class Telemetry:
    """Publishes ticks, events and status: a topic and one JSON object each; waits for nobody."""

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
