"""Publishes ticks, events and status over ZeroMQ; nothing here ever waits for a subscriber."""

import msgspec
import zmq

from fishd.addresses import bind
from fishd.signals import Event, Status, Tick

QUEUE = 100
"""Messages kept for a slow subscriber, five seconds of ticks; later ones are dropped for it."""


class Telemetry:
    """A PUB socket: a topic frame and one JSON object. It lives as long as its context."""

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", address: str) -> None:
        """Raises `StartupError` when the address cannot be bound."""
        self._encode = msgspec.json.Encoder().encode
        self._socket = context.socket(zmq.PUB)
        self._socket.set(zmq.SNDHWM, QUEUE)
        self._socket.set(zmq.LINGER, 0)
        bind(self._socket, address, key="telemetry.address")
        self.address = self._socket.get_string(zmq.LAST_ENDPOINT)

    def tick(self, tick: Tick) -> None:
        """Publish on topic `tick`."""
        self._send(b"tick", tick)

    def event(self, event: Event) -> None:
        """Publish on topic `event`."""
        self._send(b"event", event)

    def status(self, status: Status) -> None:
        """Publish on topic `status`."""
        self._send(b"status", status)

    def _send(self, topic: bytes, message: Tick | Event | Status) -> None:
        self._socket.send_multipart((topic, self._encode(message)), zmq.DONTWAIT)
