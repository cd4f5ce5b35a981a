"""Publishes ticks, events and status; nothing here ever waits for anybody.

They go to the gateway of telemetry, a process of its own, which has a PUB socket.
"""

from collections.abc import Callable

import msgspec

from fishd.core.signals import Event, Status, Tick
from fishd.daemon.gateway.link import published


class Telemetry:
    """A topic and one JSON object a message."""

    def __init__(self, send: Callable[[bytes], object]) -> None:
        """send: takes a message for the gateway, without waiting"""
        self._encode = msgspec.json.Encoder().encode
        self._send = send

    def tick(self, tick: Tick) -> None:
        """Publish on topic `tick`."""
        self._send(published(b"tick", self._encode(tick)))

    def event(self, event: Event) -> None:
        """Publish on topic `event`."""
        self._send(published(b"event", self._encode(event)))

    def status(self, status: Status) -> None:
        """Publish on topic `status`."""
        self._send(published(b"status", self._encode(status)))
