"""Gateway of telemetry: a PUB socket that publishes the messages from the link."""

import mmap
import select
import socket
import struct
from contextlib import suppress
from typing import TYPE_CHECKING

import zmq

from fishd.daemon.gateway.limits import ResourceLimits
from fishd.daemon.gateway.link import END, LISTEN, PING, PONG, listen, split_frames

if TYPE_CHECKING:
    from fishd.daemon.gateway.keys import KnownKeys

SOCKET = zmq.PUB
MAX_MEMORY_BYTES = 16 * 2**20
"""Largest memory in addition to that at the start [bytes]."""
MAX_CONNECTIONS = 200
"""Largest number of connections, of subscribers and of other programs."""

MAX_QUEUED_MESSAGES = 100
"""Messages kept for a slow subscriber, five seconds of ticks; it misses the later ones."""
MAX_TELEMETRY_BYTES = 2**20
"""Largest message from the link [bytes]."""
MAX_RECEIVED_BYTES = 512
"""Largest message from a subscriber, a topic or a handshake [bytes]."""
HANDSHAKE_TIMEOUT_MS = 2000
"""Longest time for the handshake of a connection [ms]."""
_LISTENER_BYTES = socket.CMSG_SPACE(struct.calcsize("i"))
"""Size of the ancillary data with a file descriptor [bytes]."""
_CHECK_PERIOD_MS = 100
"""Longest time between two checks of the limits [ms]."""


def run(
    link: socket.socket,
    server: "zmq.Socket[bytes]",
    limits: ResourceLimits,
    known: "KnownKeys | None",
) -> str:
    """Publish until fishd ends; return the exceeded limit, if any, or which key was removed."""
    # Kept, because `recv` would ask the system for as much memory for each message.
    buffer = memoryview(mmap.mmap(-1, MAX_TELEMETRY_BYTES))
    poller = select.poll()
    poller.register(link, select.POLLIN)
    while not (why := limits.exceeded() or (known.find_change() if known else "")):
        if not poller.poll(_CHECK_PERIOD_MS):
            continue
        try:
            size, ancillary, _, _ = link.recvmsg_into([buffer], _LISTENER_BYTES)
            message = bytes(buffer[:size])
        except ConnectionResetError:  # fishd was killed
            return ""
        if message in (b"", END):
            return ""
        if message == PING:
            with suppress(OSError):  # the next `recv` notices that fishd was killed
                link.send(PONG)
            continue
        if message.startswith(LISTEN):
            listen(server, message, *struct.unpack("i", ancillary[0][2]))
            continue
        server.send_multipart(split_frames(message), zmq.DONTWAIT)
    return why


def configure(server: "zmq.Socket[bytes]") -> None:
    """Set the limits for each subscriber."""
    server.set(zmq.SNDHWM, MAX_QUEUED_MESSAGES)
    server.set(zmq.MAXMSGSIZE, MAX_RECEIVED_BYTES)
    server.set(zmq.HANDSHAKE_IVL, HANDSHAKE_TIMEOUT_MS)
