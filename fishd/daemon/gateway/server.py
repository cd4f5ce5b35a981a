"""The sockets of a gateway: a ROUTER for requests, and a publisher of telemetry."""

import mmap
import select
import socket
import struct
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import zmq

from fishd.core import protocol
from fishd.daemon.gateway.limits import ResourceLimits
from fishd.daemon.gateway.link import (
    CLOSED,
    CONTROL,
    LISTEN,
    MAX_TELEMETRY_BYTES,
    PING,
    PONG,
    READY,
    TELEMETRY,
    TICKS,
    is_reply,
    read_listen,
    split_frames,
)
from fishd.daemon.gateway.router import Router

if TYPE_CHECKING:
    from fishd.daemon.gateway.keys import KnownKeys

MAX_MEMORY_BYTES = 32 * 2**20
"""Largest memory in addition to that at the start [bytes]."""
MAX_CONNECTIONS = 800
"""Largest number of connections of clients, subscribers and other programs."""
MAX_QUEUED_MESSAGES = 100
"""Messages kept for a slow subscriber, five seconds of ticks; it misses the later ones."""
MAX_QUEUED_REQUESTS, MAX_QUEUED_REPLIES = 8, 64
"""Requests and replies that ZeroMQ queues for one client; further replies are dropped."""
MAX_TOPIC_BYTES = 512
"""Largest message from a subscriber, a topic or a handshake [bytes]."""
HANDSHAKE_TIMEOUT_MS = 2000
"""Longest time for the handshake of a connection [ms]."""
_MAX_TOPICS_PER_TURN = 1000
"""Number of subscriptions that are read before other messages are."""
_POLL_MS = 1000
"""Longest time between two checks of the limits [ms]; heartbeats make it shorter."""
_LINGER_MS = 100
"""Longest time for the last messages to leave [ms]."""
_TICK = b"tick"
_OPTIONS = {
    TELEMETRY: (zmq.XPUB, {zmq.SNDHWM: MAX_QUEUED_MESSAGES, zmq.MAXMSGSIZE: MAX_TOPIC_BYTES}),
    CONTROL: (
        zmq.ROUTER,
        {
            zmq.RCVHWM: MAX_QUEUED_REQUESTS,
            zmq.SNDHWM: MAX_QUEUED_REPLIES,
            zmq.MAXMSGSIZE: protocol.MAX_MESSAGE,
        },
    ),
}


class GatewayServer:
    """Server of both sockets, each of which begins to listen when its listener has come."""

    def __init__(self, link: socket.socket) -> None:
        """link: link to fishd, over which the listeners come"""
        self._link = link
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._servers: dict[str, zmq.Socket[bytes]] = {}
        self._known: KnownKeys | None = None
        self._tick_topics: set[bytes] = set()
        """Subscriptions that match ticks: `tick`, or a prefix of it."""
        self._gets_ticks = False
        # Kept, because `recv` would ask the system for as much memory for each message.
        self._buffer = memoryview(mmap.mmap(-1, MAX_TELEMETRY_BYTES))
        self._router: Router | None = None
        self._poller = zmq.Poller()
        self._poller.register(link, zmq.POLLIN)

    def run(self) -> str:
        """Serve until fishd ends; return the exceeded limit, if any.

        Raise ConnectionError when fishd was killed.
        """
        while len(self._servers) < len(_OPTIONS):
            select.select([self._link], [], [])
            if not self._take_message():
                return ""
        control = self._servers[CONTROL]
        self._router = router = Router(self._link, control, self._known)
        limits = ResourceLimits(MAX_MEMORY_BYTES, MAX_CONNECTIONS)
        self._tell(READY)
        while not (why := limits.exceeded()):
            ready = dict(self._poller.poll(_POLL_MS))
            if self._link.fileno() in ready and not self._take_message():
                self._context.destroy(linger=_LINGER_MS)
                break
            if control in ready:
                router.take_requests()
            telemetry = self._servers.get(TELEMETRY)
            if telemetry and telemetry in ready:
                self._take_subscriptions(telemetry)
            self._request_ticks()
            router.pass_on()
            if self._known and telemetry and (change := self._known.find_change()):
                self._close_telemetry(change)
        return why

    def _take_message(self) -> bool:
        """Handle a message from fishd; return False if it is the last one."""
        space = socket.CMSG_SPACE(struct.calcsize("i"))
        size, ancillary, _, _ = self._link.recvmsg_into([self._buffer], space)
        message = bytes(self._buffer[:size])
        if not message:
            return False
        if message == PING:
            self._tell(PONG)
        elif message.startswith(LISTEN):
            self._listen(message, *struct.unpack("i", ancillary[0][2]))
        elif not self._router:
            pass  # for the gateway before this one
        elif is_reply(message):
            self._router.take_reply(message)
        elif telemetry := self._servers.get(TELEMETRY):
            telemetry.send_multipart(split_frames(message), zmq.DONTWAIT)
        return True

    def _tell(self, message: bytes) -> None:
        with suppress(BlockingIOError):  # fishd has not read what is queued; it asks again
            self._link.send(message)

    def _listen(self, message: bytes, listener: int) -> None:
        """Let a socket listen at the address in a message, too; `listener` is its file descriptor.

        Connections end with the listener through which they came, so former ones are kept.
        """
        kind, address, keys = read_listen(message)
        server = self._servers.get(kind) or self._open(kind, keys)
        server.set(zmq.USE_FD, listener)
        server.bind(address)

    def _open(self, kind: str, keys: str) -> "zmq.Socket[bytes]":
        number, options = _OPTIONS[kind]
        server = self._servers[kind] = self._context.socket(number)
        self._poller.register(server, zmq.POLLIN)
        server.set(zmq.HANDSHAKE_IVL, HANDSHAKE_TIMEOUT_MS)
        for option, value in options.items():
            server.set(option, value)
        if keys:
            from fishd.daemon.gateway.keys import KnownKeys, judge_handshakes, require_keys

            secret, folder = keys.split(" ", 1)
            if self._known is None:
                self._known = KnownKeys(Path(folder))
                judge_handshakes(self._context, self._known)
            require_keys(server, secret)
        return server

    def _close_telemetry(self, why: str) -> None:
        """End the connections of all subscribers, until fishd sends the listener again.

        One of them may have a key that was removed. Each request is checked by itself.
        """
        telemetry = self._servers.pop(TELEMETRY)
        self._poller.unregister(telemetry)
        telemetry.close(linger=0)
        self._tick_topics.clear()
        self._link.send(CLOSED + why.encode())

    def _take_subscriptions(self, telemetry: "zmq.Socket[bytes]") -> None:
        """Note which subscriptions match ticks."""
        for _ in range(_MAX_TOPICS_PER_TURN):
            try:
                message = telemetry.recv(zmq.DONTWAIT)
            except zmq.Again:
                return
            kind, topic = message[:1], message[1:]
            if kind == b"\x01" and _TICK.startswith(topic):
                self._tick_topics.add(topic)
            elif kind == b"\x00":
                self._tick_topics.discard(topic)

    def _request_ticks(self) -> None:
        """Tell fishd when the first subscription matches ticks, or the last one has ended."""
        if self._gets_ticks != bool(self._tick_topics):
            with suppress(BlockingIOError):  # try again in the next turn
                self._link.send(TICKS + bytes([not self._gets_ticks]))
                self._gets_ticks = not self._gets_ticks
