"""The gateway of telemetry: a PUB socket that publishes what comes over the link."""

import select
import socket
from contextlib import suppress

import zmq

from fishd.daemon.gateway.limits import ResourceLimits
from fishd.daemon.gateway.link import END, PING, PONG, frames

SOCKET = zmq.PUB
MEMORY = 16 * 2**20
"""Beyond what it starts with [bytes]."""
CONNECTIONS = 200
"""Subscribers, and others that connect."""

QUEUE = 100
"""Messages kept for a slow subscriber, five seconds of ticks; later ones are dropped for it."""
LONGEST = 512
"""Of what a subscriber sends: a topic, or the greeting of its connection [bytes]."""
GREETING = 2000
"""How long a connection may take for it [ms]."""
_LOOK = 100
"""Longest time between two looks at the limits [ms]."""


def run(link: socket.socket, server: "zmq.Socket[bytes]", limits: ResourceLimits) -> str:
    """Publish until fishd ends; returns which limit was exceeded, or nothing."""
    waiting = select.poll()
    waiting.register(link, select.POLLIN)
    while not (why := limits.exceeded()):
        if not waiting.poll(_LOOK):
            continue
        try:
            message = link.recv(2**20)
        except ConnectionResetError:  # fishd was killed
            return ""
        if message in (b"", END):
            return ""
        if message == PING:
            with suppress(OSError):  # of a fishd that was killed, the next look tells
                link.send(PONG)
            continue
        server.send_multipart(frames(message), zmq.DONTWAIT)
    return why


def configure(server: "zmq.Socket[bytes]") -> None:
    """What holds for every subscriber."""
    server.set(zmq.SNDHWM, QUEUE)
    server.set(zmq.MAXMSGSIZE, LONGEST)
    server.set(zmq.HANDSHAKE_IVL, GREETING)
