"""The two sockets of `fishd-camera`: frames go out of one, requests come in at the other."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import zmq

from fishd.camera.messages import STATE, VIEW
from fishd.core import addresses, protocol, text
from fishd.core.errors import Refused
from fishd.core.schema import nearest

QUEUE = 256
"""Messages kept for a slow subscriber; later ones are dropped for it."""
LONGEST_TOPIC = 512
"""Of what a subscriber sends [bytes]."""
GREETING = 2000
"""How long a connection may take until it speaks ZeroMQ [ms]."""
_AT_ONCE = 20
"""Requests or subscriptions that are taken before frames are looked at."""
_RIVAL = "another fishd-camera"
_IN_USE = "it is in use, by another fishd-camera perhaps; end that, or choose another address"
_ADVICE = "end it, or give this one another publish.frames and publish.requests"


class Publisher:
    """The socket for frames; an XPUB, to know what is wanted. Waits for nobody."""

    def __init__(self, address: str, stack: ExitStack) -> None:
        """Raises `StartupError`."""
        self.socket, self.address = _listening(zmq.XPUB, address, "publish.frames", stack)
        self._topics: set[bytes] = set()
        """Those by which somebody gets views: `view`, or how that begins."""

    def send(self, parts: list[bytes]) -> None:
        """Publish a message."""
        self.socket.send_multipart(parts, zmq.DONTWAIT)

    @property
    def views_wanted(self) -> bool:
        """Has anybody subscribed to pictures for people?"""
        return bool(self._topics)

    def take_subscriptions(self) -> bool:
        """Note what is wanted; true where somebody has just subscribed to the state."""
        state = False
        for (message,) in _waiting(self.socket, 1):
            topic = message[1:]
            if message[:1] == b"\x01":
                if VIEW.startswith(topic):
                    self._topics.add(topic)
                state = state or STATE.startswith(topic)
            else:
                self._topics.discard(topic)
        return state


class Requests:
    """The socket for requests, each answered at once."""

    def __init__(self, address: str, stack: ExitStack) -> None:
        """Raises `StartupError`."""
        self.socket, self.address = _listening(zmq.ROUTER, address, "publish.requests", stack)
        self.operations: dict[str, Callable[[], Any]] = {}
        """What can be asked for, by name."""

    def answer(self) -> None:
        """Answer what waits; what is no request gets an error, or nothing."""
        for frames in _waiting(self.socket):
            envelope, payload = frames[:-1], frames[-1]
            if len(envelope) == 1 or (len(envelope) == 2 and not envelope[1]):
                self.socket.send_multipart([*envelope, self._reply(payload)], zmq.DONTWAIT)

    def _reply(self, payload: bytes) -> bytes:
        try:
            request = protocol.decode_request(payload)
            if request.op not in self.operations:
                hint = nearest(request.op, list(self.operations))
                raise Refused("unknown-op", f"no such op '{text.quoted(request.op)}'; {hint}")
            if request.args:
                raise Refused("bad-arguments", f"{request.op} takes no arguments")
        except Refused as error:
            return protocol.failure(protocol.request_id(payload), error)
        return protocol.success(request.id, self.operations[request.op]())


def _waiting(socket: "zmq.Socket[bytes]", parts: int | None = None) -> Iterator[list[bytes]]:
    """Messages that wait, with so many parts."""
    for _ in range(_AT_ONCE):
        try:
            found = socket.recv_multipart(zmq.DONTWAIT)
        except zmq.Again:
            return
        if parts in (None, len(found)):
            yield found


def _listening(
    kind: int, address: str, key: str, stack: ExitStack
) -> tuple["zmq.Socket[bytes]", str]:
    """A socket that listens until `stack` is closed, and its address; raises `StartupError`."""
    stack.enter_context(addresses.claimed(address, _RIVAL, _ADVICE))
    listener = addresses.listen(address, key, in_use=_IN_USE)
    stack.callback(listener.close)
    served = addresses.served(address, listener)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    stack.callback(context.destroy, linger=0)
    socket = context.socket(kind)
    socket.set(zmq.LINGER, 0)
    socket.set(zmq.SNDHWM, QUEUE)
    socket.set(zmq.HANDSHAKE_IVL, GREETING)
    longest = LONGEST_TOPIC if kind == zmq.XPUB else protocol.MAX_MESSAGE
    socket.set(zmq.MAXMSGSIZE, longest)
    if kind == zmq.XPUB:
        socket.set(zmq.XPUB_VERBOSE, 1)
    else:
        socket.set(zmq.RCVHWM, _AT_ONCE)
    socket.set(zmq.USE_FD, os.dup(listener.fileno()))
    socket.bind(served)
    return socket, served
