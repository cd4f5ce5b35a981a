"""Socket of the requests of `Fish`; it works without zmq, so that most commands start faster."""

import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TypeVar

from fishd.core.errors import FishError, NoDaemon, NoKey
from fishd.core.zmtp import Dealer

T = TypeVar("T")

MAX_REPLY_BYTES = 64 * 2**20
"""Maximum size of a reply [bytes]."""
MAX_UNANSWERED_S = 1.0
"""Time from a request to the end of its TCP connection if nothing is answered: a router may have
forgotten it, and the next request connects again [s]."""


class Requests(ABC):
    """Connection of requests to a daemon."""

    connections: int
    """Number of connections established until the latest `state`."""
    _inbox: deque[bytes | FishError]
    _endpoint: str
    is_interrupted = False
    """Whether `interrupt` was called."""
    _ready = False

    def is_connected(self, connection: int) -> bool:
        """Return whether the connection of this number still exists."""
        return self._ready and self.connections == connection

    def take(self) -> bytes:
        """Return a message, only if `state` reports one; raise `FishError` for an invalid one."""
        reply = self._inbox.popleft()
        if isinstance(reply, FishError):
            raise reply
        return reply

    def wait_until(self, deadline: float) -> bool:
        """Wait until `state` may have changed; return False after the deadline [s]."""
        remaining = deadline - time.monotonic()
        if remaining > 0.0:
            self.wait(remaining)
        return remaining > 0.0

    @abstractmethod
    def state(self) -> tuple[bool, bool]:
        """Return whether a message can be sent, and whether there is one to receive."""

    @abstractmethod
    def send(self, payload: bytes) -> None:
        """Send a message; only if `state` allows it."""

    @abstractmethod
    def wait(self, seconds: float) -> None:
        """Wait until `state` may have changed, at most for this time [s]."""

    @abstractmethod
    def interrupt(self) -> None:
        """End the wait of another thread, whose request then raises `FishError`."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; may be called twice."""


class Requester:
    """Requests over a connection that is opened again where it may have died without an end."""

    def __init__(self, open_socket: Callable[[], Requests], forgettable: bool) -> None:
        """
        open_socket: connects, or raises `FishError`
        forgettable: whether there may be a router that forgets the connection
        """
        self._open_socket, self._forgettable = open_socket, forgettable
        self._socket: Requests | None = None
        self._asked = 0.0
        """Time of the first request since the latest answer [s, monotonic]; 0 without one."""

    def exchange(
        self,
        request: bytes,
        read: Callable[[bytes], T | None],
        deadlines: Iterable[float],
        may_repeat: bool = True,
    ) -> T | None:
        """Send a request, and return its result; None if there is none by the last deadline.

        read: returns the result in a reply, None in one to an earlier request
        deadlines: times to wait until, one after another [s, monotonic]
        may_repeat: whether to send it again if the connection is lost

        Raise `ConnectionResetError` if the connection was lost after the request was sent.
        """
        connection = self._socket = self._socket or self._open_socket()
        self._asked = self._asked or time.monotonic()
        sent_on = None
        """Number of the connection over which the request was sent."""
        for deadline in deadlines:
            while True:
                can_send, is_waiting = connection.state()
                if connection.is_interrupted:
                    raise FishError("the client was closed during a request")
                if sent_on is None and can_send:
                    sent_on = connection.connections
                    connection.send(request)
                elif sent_on is not None and is_waiting:
                    self._asked = 0.0
                    result = read(connection.take())
                    if result is not None:
                        return result
                elif sent_on is not None and not connection.is_connected(sent_on):
                    if not may_repeat:
                        self._asked = 0.0
                        raise ConnectionResetError
                    sent_on = None
                elif not connection.wait_until(deadline):
                    break
        if self._asked and time.monotonic() - self._asked >= MAX_UNANSWERED_S and self._forgettable:
            self.disconnect()
        return None

    def interrupt(self) -> None:
        """End the request of another thread, which then raises `FishError`."""
        if self._socket:
            self._socket.interrupt()

    def disconnect(self) -> None:
        """Close the connection; the next request opens another one."""
        if self._socket:
            self._socket.close()
        self._socket, self._asked = None, 0.0


class RequestSocket(Dealer[bytes | FishError], Requests):
    """Connection to the control socket of a daemon."""

    RETRY_S = 0.02
    HANDSHAKE_S = 30.0

    def __init__(self, endpoint: str, program: str = "fishd") -> None:
        """Raises `NoDaemon` if the endpoint is not an address; program: name of the server."""
        self._endpoint, self._program = endpoint, program
        try:
            super().__init__(endpoint, MAX_REPLY_BYTES)
        except ValueError as error:
            raise NoDaemon(f"'{endpoint}' is not an address: {error}") from None

    def state(self) -> tuple[bool, bool]:
        """Return whether a message can be sent, and whether there is one to receive."""
        state = super().state()
        if self.needs_key:
            from fishd.core.keys import KNOWN_FILE, client_folder

            raise NoKey(
                f"the fishd at {self._endpoint} needs a key, and {client_folder() / KNOWN_FILE} "
                f"has no line '{self._endpoint} KEY'; add it, with the key of that fishd, and make "
                "a key for this client with 'fishctl keygen'"
            )
        return state

    def interrupt(self) -> None:
        """End the wait of another thread, whose request then raises `FishError`."""
        self.is_interrupted = True
        if connected := self._socket:
            with suppress(OSError):
                connected.shutdown(socket.SHUT_RDWR)

    def _decode(self, payload: bytes) -> bytes:
        return payload

    def _bad(self, what: str) -> FishError:
        return FishError(
            f"the program at {self._endpoint} is not a {self._program}: it sent {what}"
        )
