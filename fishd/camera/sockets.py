"""Sockets of `fishd-camera`: one publishes frames, the other receives requests."""

import os
import socket as sockets
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import msgspec
import zmq
from msgspec import Struct

from fishd.camera.messages import STATE, VIEW
from fishd.core import addresses, protocol, text
from fishd.core.errors import Refused
from fishd.core.schema import suggest
from fishd.core.socket_file import SocketFile

MAX_QUEUED_MESSAGES = 256
"""Largest number of messages that wait for a slow subscriber; later ones are dropped for it."""
MAX_TOPIC_BYTES = 512
"""Largest message from a subscriber [bytes]."""
HANDSHAKE_TIMEOUT_MS = 2000
"""Longest time until a new connection has completed the ZeroMQ handshake [ms]."""
_MAX_REQUESTS_PER_TURN = 20
"""Largest number of requests that are answered before frames are published."""
_MAX_SUBSCRIPTIONS_PER_TURN = 1000
"""Largest number of subscriptions that are read before frames are published."""
_RIVAL = "another fishd-camera"
_IN_USE = "it is in use, perhaps by another fishd-camera; end that, or choose another address"
_ADVICE = "end it, or give this one another publish.frames and publish.requests"


class _Listener:
    """ZeroMQ socket that listens, and whose file can be created again."""

    kind: int
    key: str
    """Key of its address in the settings."""

    def __init__(self, address: str, stack: ExitStack) -> None:
        """Listen at an address; raises `StartupError`."""
        listener, self.address = _listen(address, self.key, stack)
        self.file = SocketFile(self, self.address, self.key, group=False)
        self._stack = ExitStack()
        stack.callback(lambda: self._stack.close())
        self.listen_at(self.address, listener)

    def listen_at(self, address: str, listener: sockets.socket) -> None:
        """Listen at a new file from now on; all clients connect again."""
        self._stack.close()
        self._stack = ExitStack()
        self.socket = _bind(self.kind, address, listener, self._stack)


class Publisher(_Listener):
    """Non-blocking XPUB socket for frames, which reports the topics of its subscribers."""

    kind, key = zmq.XPUB, "publish.frames"

    def listen_at(self, address: str, listener: sockets.socket) -> None:
        """Listen at a new file from now on; all subscribers connect again."""
        self._topics: set[bytes] = set()
        """Subscriptions that match views: `view`, or a prefix of it."""
        super().listen_at(address, listener)

    def send(self, parts: list[bytes]) -> None:
        """Publish a message."""
        self.socket.send_multipart(parts, zmq.DONTWAIT)

    @property
    def views_wanted(self) -> bool:
        """Whether there is a subscription to pictures for people."""
        return bool(self._topics)

    def take_subscriptions(self) -> bool:
        """Note which topics are wanted; return whether a new subscription is to the state."""
        state = False
        for (message,) in _receive(self.socket, 1, _MAX_SUBSCRIPTIONS_PER_TURN):
            kind, topic = message[:1], message[1:]
            if kind == b"\x01":
                if VIEW.startswith(topic):
                    self._topics.add(topic)
                state = state or STATE.startswith(topic)
            elif kind == b"\x00":
                self._topics.discard(topic)
        return state


class Requests(_Listener):
    """Socket for requests, each answered at once."""

    kind, key = zmq.ROUTER, "publish.requests"

    def __init__(self, address: str, stack: ExitStack) -> None:
        """Listen at an address; raises `StartupError`."""
        super().__init__(address, stack)
        self.operations: dict[str, Callable[..., Any]] = {}
        """Functions that compute the results of requests, by name of the operation."""
        self.arguments: dict[str, type[Struct]] = {}
        """Kinds of the arguments of those that take any."""

    def answer(self) -> None:
        """Answer the waiting requests; an invalid message gets an error, or no answer."""
        for frames in _receive(self.socket):
            envelope, payload = frames[:-1], frames[-1]
            if len(envelope) == 1 or (len(envelope) == 2 and not envelope[1]):
                self.socket.send_multipart([*envelope, self._reply(payload)], zmq.DONTWAIT)

    def _reply(self, payload: bytes) -> bytes:
        try:
            request = protocol.decode_request(payload)
            if request.op not in self.operations:
                hint = suggest(request.op, list(self.operations))
                raise Refused("unknown-op", f"no such op '{text.quoted(request.op)}'; {hint}")
            kind = self.arguments.get(request.op)
            if request.args and kind is None:
                raise Refused("bad-arguments", f"{request.op} takes no arguments")
            values = () if kind is None else (msgspec.convert(request.args, kind),)
            return protocol.success(request.id, self.operations[request.op](*values))
        except msgspec.ValidationError as error:
            refusal = Refused("bad-arguments", text.line(str(error)))
            return protocol.failure(protocol.request_id(payload), refusal)
        except Refused as error:
            return protocol.failure(protocol.request_id(payload), error)


def _receive(
    socket: "zmq.Socket[bytes]",
    parts: int | None = None,
    count: int = _MAX_REQUESTS_PER_TURN,
) -> Iterator[list[bytes]]:
    """Yield at most `count` waiting messages, and only those with this number of parts."""
    for _ in range(count):
        try:
            message = socket.recv_multipart(zmq.DONTWAIT)
        except zmq.Again:
            return
        if parts in (None, len(message)):
            yield message


def _listen(address: str, key: str, stack: ExitStack) -> tuple[sockets.socket, str]:
    """Return a socket that listens until `stack` is closed, and its address.

    Raises `StartupError`.
    """
    stack.enter_context(addresses.claim_address(address, _RIVAL, _ADVICE))
    listener = addresses.listen(address, key, in_use=_IN_USE)
    stack.callback(listener.close)
    return listener, addresses.reachable_address(address, listener)


def _bind(
    kind: int, address: str, listener: sockets.socket, stack: ExitStack
) -> "zmq.Socket[bytes]":
    """Return a ZeroMQ socket for the connections of a listener, until `stack` is closed."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    stack.callback(context.destroy, linger=0)
    socket = context.socket(kind)
    socket.set(zmq.LINGER, 0)
    socket.set(zmq.SNDHWM, MAX_QUEUED_MESSAGES)
    socket.set(zmq.RCVHWM, _MAX_REQUESTS_PER_TURN)
    socket.set(zmq.HANDSHAKE_IVL, HANDSHAKE_TIMEOUT_MS)
    max_bytes = MAX_TOPIC_BYTES if kind == zmq.XPUB else protocol.MAX_MESSAGE
    socket.set(zmq.MAXMSGSIZE, max_bytes)
    if kind == zmq.XPUB:
        socket.set(zmq.XPUB_VERBOSE, 1)
    socket.set(zmq.USE_FD, os.dup(listener.fileno()))
    socket.bind(address)
    return socket
