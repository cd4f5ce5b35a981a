"""Emulated pigpiod: a TCP server for the real pigpio client, which runs unchanged.

The emulated tank reads the pulses of a pin from it. Scripts and frames are evaluated lazily: they
advance to the current time at each request of a client or the tank.
"""

import contextlib
import math
import os
import select
import socket
import struct
import threading
import time

from fishd.core.clock import Clock
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.pigpiod.commands import NAMES, UNKNOWN_TO_OLD, Commands
from fishd.virtual.pi.pulse_train import Edge

POLL_PERIOD_S = 5e-3
"""Time between two checks of the clock while a fault or a notification is active [s]."""
MAX_EXTENSION_BYTES = 65_535
"""Largest extension of a command; pigpiod drops a client that announces more [bytes]."""
_OPEN_NOTIFICATION = NAMES.index("NOIB")
_HEADER = struct.Struct("<4I")
"""Header of a command: number, p1, p2, length of the extension; in a reply, the result is last."""


class Connection:
    """Connection that executes the commands of one client in their order."""

    def __init__(self, client: socket.socket, commands: Commands) -> None:
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = client
        self._commands = commands
        self._input = bytearray()
        self.notification: int | None = None
        """Handle of the notifications that this connection receives."""

    def receive(self, time: float) -> bool:
        """Read and execute commands at a time [s]; return False if the client has disconnected."""
        try:
            data = self.socket.recv(MAX_EXTENSION_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self._input += data
        return bool(data) and self._execute_input(time)

    def hang_up(self) -> None:
        """Shut down the connection; the server then detects that it is closed."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)

    def _send(self, data: bytes) -> None:
        """Send data, or disconnect a client that does not read its replies."""
        try:
            if self.socket.send(data) == len(data):
                return
        except OSError:
            pass
        self.hang_up()

    def _execute_input(self, time: float) -> bool:
        while len(self._input) >= _HEADER.size:
            number, p1, p2, length = _HEADER.unpack_from(self._input)
            if length > MAX_EXTENSION_BYTES:
                return False
            end = _HEADER.size + length
            if len(self._input) < end:
                break
            extension = bytes(self._input[_HEADER.size : end])
            del self._input[:end]
            self._answer(time, number, p1, p2, extension)
        return True

    def _answer(self, time: float, number: int, p1: int, p2: int, extension: bytes) -> None:
        extra_bytes = b""
        if number == _OPEN_NOTIFICATION:
            result = self.notification = self._commands.open_notification(self._send)
        else:
            result, extra_bytes = self._commands.execute(time, number, p1, p2, extension)
        self._send(_HEADER.pack(number, p1, p2, result & 0xFFFFFFFF) + extra_bytes)


class Pigpiod:
    """Emulated daemon; call `start` before use and `close` after. Safe for use from any thread."""

    def __init__(self, clock: Clock, faults: Faults, port: int = 0, lead: float = 0.0) -> None:
        """
        port: 0 for any free port
        lead: time by which its own clock, which starts the frames of pulses, is ahead [s]
        """
        self._clock = clock
        self._lead = lead
        self._faults = faults
        self._address = ("127.0.0.1", port)
        self._commands = Commands()
        self._lock = threading.Lock()
        self._connections: dict[int, Connection] = {}
        self._running = self._gone = self._frozen = False
        self._frozen_until = math.inf
        for name in ("pigpiod-gone", "pigpiod-frozen"):
            faults.listen(name, self._begin_fault)
        faults.listen("pigpiod-restart", self._restart)

    @property
    def port(self) -> int:
        """TCP port of the server, after `start`."""
        return self._address[1]

    def start(self) -> None:
        """Listen; raises OSError when the port is taken."""
        with self._bind_socket() as chosen:
            self._address = chosen.getsockname()[:2]
            # Unlike a port that the kernel chose, one that was asked for outlasts a `shutdown`.
            self._listener = self._bind_socket()
        self._epoll = select.epoll()
        self._waker = os.eventfd(0)
        self._epoll.register(self._waker, select.EPOLLIN)
        self._listen()
        self._running = True
        self._thread = threading.Thread(target=self._serve, name="pigpiod", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close all connections and end the thread; pulses continue."""
        with self._lock:
            if not self._running:
                return
            self._running = False
        os.eventfd_write(self._waker, 1)
        self._thread.join()
        for connection in list(self._connections.values()):
            self._drop(connection)
        self._listener.close()
        self._epoll.close()
        os.close(self._waker)

    def width(self, gpio: int, time: float) -> float:
        """Return the pulse width [µs] at a time up to now [s]; 0 without pulses."""
        with self._lock:
            self._catch_up()
            return self._commands.pins.pins[gpio].train.width(time + self._lead)

    def history(self, gpio: int) -> list[tuple[float, float]]:
        """Return the latest changes of the pulses: time of the effect [s] and width [µs]."""
        with self._lock:
            self._catch_up()
            history = self._commands.pins.pins[gpio].train.history
        return [(time - self._lead, width) for time, width in history]

    def edges(self, gpio: int, begin: float, end: float) -> list[Edge]:
        """Return the edges of a pin from `begin` to before `end` [s], at most until now."""
        with self._lock:
            self._catch_up()
            train, lead = self._commands.pins.pins[gpio].train, self._lead
            edges = list(train.edges(begin + lead, end + lead))
        return [Edge(edge.time - lead, edge.level) for edge in edges]

    def connect(self, gpio: int, source: int) -> None:
        """Connect a pin to another one, which drives it while it is an input."""
        self._commands.pins.wires[gpio] = source

    def stands_still(self) -> bool:
        """Return whether it is frozen; then it does not answer until the clock advances."""
        with self._lock:
            self._catch_up()
            return self._frozen

    def _begin_fault(self) -> None:
        with self._lock:
            remaining = self._faults.listing().get("pigpiod-frozen")
            self._frozen_until = (
                math.inf if remaining is None else self._clock.monotonic() + self._lead + remaining
            )
            self._catch_up()
        self._wake()

    def _restart(self) -> None:
        with self._lock:
            now = self._catch_up()
            if self._running and not self._gone:
                self._die(now)
                self._listen()
        self._wake()

    def _catch_up(self) -> float:
        """Advance to the current time and check the faults; return the time [s]."""
        now = self._clock.monotonic() + self._lead
        if not self._running:
            return now
        faults = self._faults
        gone = frozen = False
        if not faults.none:
            gone, frozen = faults.active("pigpiod-gone"), faults.active("pigpiod-frozen")
            is_old = faults.active("pigpiod-old")
            self._commands.unknown = UNKNOWN_TO_OLD if is_old else frozenset()
        if gone != self._gone:
            self._gone = gone
            if gone:
                self._commands.advance(now)
                self._die(now)
            else:
                self._listen()
        if frozen != self._frozen:
            if frozen:
                self._commands.advance(now)
            else:
                self._commands.resume(min(now, self._frozen_until))
            self._frozen = frozen
        if not frozen:
            self._commands.advance(now)
            self._commands.notify(now, not faults.none and faults.active("pulse-jitter"))
        return now

    def _serve(self) -> None:
        timeout: float | None = 0.0
        while True:
            events = self._epoll.poll(timeout)
            with self._lock:
                if not self._running:
                    return
                now = self._catch_up()
                if not self._frozen:
                    for descriptor, _ in events:
                        self._handle_event(descriptor, now)
                timeout = self._poll_timeout()
            if self._frozen:
                # Data from clients stays in the kernel, as with a stopped process.
                time.sleep(POLL_PERIOD_S)

    def _poll_timeout(self) -> float | None:
        """Return the longest wait for clients [s]; None where they alone make a difference."""
        is_polled = self._gone or self._frozen or self._commands.notifications
        return POLL_PERIOD_S if is_polled else None

    def _handle_event(self, descriptor: int, now: float) -> None:
        connection = self._connections.get(descriptor)
        if connection:
            if not connection.receive(now):
                self._drop(connection)
        elif descriptor == self._waker:
            os.eventfd_read(self._waker)
        elif descriptor == self._listener.fileno():
            # The client may have disconnected, or a fault may have closed the listener.
            with contextlib.suppress(OSError):
                client, _ = self._listener.accept()
                self._connections[client.fileno()] = Connection(client, self._commands)
                self._epoll.register(client, select.EPOLLIN)

    def _drop(self, connection: Connection) -> None:
        del self._connections[connection.socket.fileno()]
        if connection.notification is not None:
            self._commands.notifications.pop(connection.notification, None)
        self._epoll.unregister(connection.socket)
        connection.socket.close()

    def _die(self, now: float) -> None:
        for connection in list(self._connections.values()):
            self._drop(connection)
        self._commands.restart(now)
        # Bound but not listening: connections are refused, and no other process gets the port.
        self._epoll.unregister(self._listener)
        self._listener.shutdown(socket.SHUT_RD)

    def _bind_socket(self) -> socket.socket:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(self._address)
        except OSError:
            listener.close()
            raise
        listener.setblocking(False)
        return listener

    def _listen(self) -> None:
        self._listener.listen()
        self._epoll.register(self._listener, select.EPOLLIN)

    def _wake(self) -> None:
        if self._running:
            os.eventfd_write(self._waker, 1)
