"""Socket of the requests of `Fish` with a key: ZeroMQ's own, which encrypts all messages."""

import os
import struct
from collections import deque
from contextlib import suppress

import zmq

from fishd.client.request_socket import MAX_REPLY_BYTES, Requests
from fishd.client.zmq_sockets import set_keys
from fishd.core.addresses import is_ipv6
from fishd.core.errors import NoDaemon, NoKey
from fishd.core.keys import KNOWN_FILE, Access

_MAX_CUT_HANDSHAKES = 2
"""Number of handshakes in a row that fishd cuts off, from which on its key is another one: a
gateway that is started again cuts off one."""
_SEND_TIMEOUT_MS = 100
"""Longest time for a connection to accept a request [ms]."""
_EVENTS = (
    zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_DISCONNECTED
)


class KeyedRequestSocket(Requests):
    """Connection with a key to the control socket of a daemon."""

    def __init__(self, endpoint: str, access: Access) -> None:
        """Raises `NoDaemon` if the endpoint is not an address."""
        self._endpoint = endpoint
        self._inbox = deque()
        self.connections = 0
        self._access = access
        self._known = access.folder / KNOWN_FILE
        self._ready = False
        self._cut_handshakes = 0
        self._wake = os.eventfd(0)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.set(zmq.IMMEDIATE, 1)  # a request is never sent on a later connection
        self._socket.set(zmq.LINGER, 0)
        self._socket.set(zmq.SNDTIMEO, _SEND_TIMEOUT_MS)
        self._socket.set(zmq.MAXMSGSIZE, MAX_REPLY_BYTES)
        self._socket.set(zmq.RECONNECT_IVL, 20)
        self._socket.set(zmq.IPV6, is_ipv6(endpoint))
        set_keys(self._socket, access)
        self._monitor = self._socket.get_monitor_socket(_EVENTS)
        self._poller = zmq.Poller()
        for source in (self._socket, self._monitor, self._wake):
            self._poller.register(source, zmq.POLLIN)
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            why = zmq.strerror(error.errno or 0)
            raise NoDaemon(f"'{endpoint}' is not an address: {why}") from None

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if not self._context.closed:
            self._context.destroy(linger=0)
            os.close(self._wake)

    def state(self) -> tuple[bool, bool]:
        """Return whether a message can be sent, and whether there is one to receive."""
        with suppress(zmq.Again):
            while True:
                head, _ = self._monitor.recv_multipart(zmq.DONTWAIT)
                self._handle(*struct.unpack("=HI", head))
        with suppress(zmq.Again):
            if not self._inbox:
                self._inbox.append(self._socket.recv_multipart(zmq.DONTWAIT)[-1])
        return self._ready, bool(self._inbox)

    def send(self, payload: bytes) -> None:
        """Send a message; only if `state` allows it."""
        with suppress(zmq.Again):  # the connection has been lost since
            self._socket.send(payload)

    def wait(self, seconds: float) -> None:
        """Wait until `state` may have changed, at most for this time [s]."""
        self._poller.poll(int(seconds * 1e3) + 1)

    def interrupt(self) -> None:
        """End the wait of another thread, whose request then raises `FishError`."""
        self.is_interrupted = True
        os.eventfd_write(self._wake, 1)

    def _handle(self, event: int, _: int) -> None:
        """Handle an event of the connection; raise `NoKey` if fishd and this client disagree."""
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._ready = True
            self._cut_handshakes = 0
            self.connections += 1
        elif event == zmq.EVENT_DISCONNECTED:
            self._ready = False
        elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            key = zmq.curve_public(self._access.secret.encode()).decode()
            raise NoKey(
                f"this key is not known to the fishd at {self._endpoint}: add the line "
                f"'drive {key} NAME', or watch instead of drive, to the file {KNOWN_FILE} of its "
                "network.keys"
            )
        elif event in (
            zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL,
            zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL,
        ):
            self._cut_handshakes += 1
            is_final = event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
            if is_final or self._cut_handshakes >= _MAX_CUT_HANDSHAKES:
                raise NoKey(
                    f"the fishd at {self._endpoint} has another key than in its line in "
                    f"{self._known}, or uses no keys; compare the line with key.pub in the folder "
                    "network.keys of that fishd"
                )
