"""The socket through which `Fish` asks a daemon, without zmq, which most commands need not load."""

import time

from fishd.core.errors import FishError, NoDaemon
from fishd.core.zmtp import Dealer

MAX_REPLY = 64 * 2**20
"""Length of the longest reply [bytes]."""


class RequestSocket(Dealer[bytes | FishError]):
    """A connection to the control socket of a daemon."""

    RETRY_S = 0.02
    HANDSHAKE_S = 30.0

    def __init__(self, endpoint: str) -> None:
        """Raises `NoDaemon` where the endpoint is not an address."""
        self._endpoint = endpoint
        try:
            super().__init__(endpoint, MAX_REPLY)
        except ValueError as error:
            raise NoDaemon(
                f"'{endpoint}' is no address: {error}; write ipc://PATH or tcp://HOST:PORT"
            ) from None

    def send_by(self, deadline: float, request: bytes) -> bool:
        """Send a request once the daemon takes one; False where it does not [s, monotonic]."""
        while not (takes := self.state()[0]) and (left := deadline - time.monotonic()) > 0.0:
            self.wait(left)
        if takes:
            self.send(request)
        return takes

    def receive_by(self, deadline: float) -> bytes:
        """Return a reply; empty where none has come by then [s, monotonic].

        Raises `FishError` where it is not one.
        """
        while not self.state()[1]:
            if (left := deadline - time.monotonic()) <= 0.0:
                return b""
            self.wait(left)
        reply = self._inbox.popleft()
        if isinstance(reply, FishError):
            raise reply
        return reply

    def _decode(self, payload: bytes) -> bytes:
        return payload

    def _bad(self, what: str) -> FishError:
        return FishError(f"what answers at {self._endpoint} is no fishd: it sent {what}")
