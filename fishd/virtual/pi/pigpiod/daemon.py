"""An emulated pigpiod: a TCP server that the true pigpio client and `pigs` drive unchanged.

The emulated tank asks it which pulses a pin sends. Nothing in it moves by itself: scripts and
frames catch up with the clock whenever a client or the tank wants to know something.
"""

import contextlib
import math
import os
import select
import socket
import threading
import time

from fishd.core.clock import Clock
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.pigpiod.commands import Commands
from fishd.virtual.pi.pigpiod.connection import Connection

POLL = 5e-3
"""How often the server looks at the clock while something is due, and at faults that last [s]."""


class Pigpiod:
    """One daemon; `start` before use, `close` after. Its methods may be called from any thread."""

    def __init__(self, clock: Clock, faults: Faults, port: int = 0) -> None:
        """`port`: 0 takes a free one."""
        self._clock = clock
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
        """Where it listens; known once it has started."""
        return self._address[1]

    def start(self) -> None:
        """Listen; OSError when the port is taken."""
        self._listener = self._bound()
        self._address = self._listener.getsockname()[:2]
        self._epoll = select.epoll()
        self._waker = os.eventfd(0)
        self._epoll.register(self._waker, select.EPOLLIN)
        self._listen()
        self._running = True
        self._thread = threading.Thread(target=self._serve, name="pigpiod", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close all connections and end the thread; pulses are left as they are."""
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
        """The pulse at a time up to now [s], in µs; 0 for no pulses."""
        with self._lock:
            self._observe()
            return self._commands.pins.pins[gpio].train.width(time)

    def history(self, gpio: int) -> list[tuple[float, float]]:
        """The last changes of the pulses: when each took effect [s], and the width [µs]."""
        with self._lock:
            self._observe()
            return self._commands.pins.pins[gpio].train.history

    def stands_still(self) -> bool:
        """Is it frozen? Then it answers nothing before the clock moves on."""
        with self._lock:
            self._observe()
            return self._frozen

    def _begin_fault(self) -> None:
        with self._lock:
            left = self._faults.listing().get("pigpiod-frozen")
            self._frozen_until = math.inf if left is None else self._clock.monotonic() + left
            self._observe()
        self._wake()

    def _restart(self) -> None:
        with self._lock:
            now = self._observe()
            if self._running and not self._gone:
                self._die(now)
                self._listen()
        self._wake()

    def _observe(self) -> float:
        """Catch up with the clock and the faults; gives the time [s]."""
        now = self._clock.monotonic()
        if not self._running:
            return now
        faults = self._faults
        gone = frozen = False
        if not faults.none:
            gone, frozen = faults.active("pigpiod-gone"), faults.active("pigpiod-frozen")
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
            for connection in list(self._connections.values()):
                if connection.due <= now and not connection.end_delay(now):
                    self._drop(connection)
        return now

    def _serve(self) -> None:
        time_out: float | None = 0.0
        while True:
            events = self._epoll.poll(time_out)
            with self._lock:
                if not self._running:
                    return
                now = self._observe()
                if not self._frozen:
                    for descriptor, _ in events:
                        self._attend(descriptor, now)
                time_out = self._time_out(now)
            if self._frozen:
                # What clients send meanwhile stays in the kernel, as with a stopped process.
                time.sleep(POLL)

    def _time_out(self, now: float) -> float | None:
        if self._gone or self._frozen:
            return POLL
        due = min((each.due for each in self._connections.values()), default=math.inf)
        # Polled, since a virtual clock may move at any speed.
        return None if due == math.inf else min(POLL, max(0.0, due - now))

    def _attend(self, descriptor: int, now: float) -> None:
        connection = self._connections.get(descriptor)
        if connection:
            if not connection.receive(now):
                self._drop(connection)
        elif descriptor == self._waker:
            os.eventfd_read(self._waker)
        elif descriptor == self._listener.fileno():
            # A client may have changed its mind, and a fault may have closed this in between.
            with contextlib.suppress(OSError):
                client, _ = self._listener.accept()
                self._connections[client.fileno()] = Connection(client, self._commands)
                self._epoll.register(client, select.EPOLLIN)

    def _drop(self, connection: Connection) -> None:
        del self._connections[connection.socket.fileno()]
        self._epoll.unregister(connection.socket)
        connection.socket.close()

    def _die(self, now: float) -> None:
        for connection in list(self._connections.values()):
            self._drop(connection)
        self._commands.restart(now)
        self._listener.close()
        # Bound but not listening: nobody gets through, and nobody else can take the port.
        self._listener = self._bound()

    def _bound(self) -> socket.socket:
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
