"""The fish for Foxglove and Lichtblick: their WebSocket protocol, to read only.

A client subscribes to channels; each message of a subscription is binary: an opcode, the number of
the subscription, a time and the JSON that fishd sent.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import msgspec
from msgspec import Struct

from fishd.core.decoding import decoder
from fishd.core.schema import Reading, json_schema, schema_name
from fishd.core.signals import Event, Status, Tick
from fishd.window.viewer import Viewer

PROTOCOLS = "foxglove.sdk.v1", "foxglove.websocket.v1"
"""Name of the protocol, and its earlier name, which older viewers ask for; both mean the same."""
CHANNELS: dict[str, type[Struct]] = {"tick": Tick, "event": Event, "status": Status}
"""Topics, and the types of their messages."""
MAX_SUBSCRIPTIONS = 100
MAX_WAITING_MESSAGES = 200
"""Number of messages that wait for a slow client; it misses the older ones."""
_MESSAGE_DATA = 1
_WARNING = 1


class _Subscription(Struct):
    id: int
    channelId: int  # noqa: N815 (the protocol's name)


class _ClientMessage(Struct):
    op: str
    subscriptions: list[_Subscription] = []
    subscriptionIds: list[int] = []  # noqa: N815 (the protocol's name)


_decode: Callable[[bytes], _ClientMessage] = decoder(_ClientMessage)


class FoxglovePage(Viewer):
    """One connected Foxglove or Lichtblick."""

    def __init__(self, name: str, session: str, readings: Mapping[str, Reading]) -> None:
        """
        name: name of the fish
        session: differs after each start of the window
        readings: readings of its sensors, for the schema of its ticks
        """
        super().__init__()
        self._topics = dict(enumerate(CHANNELS))
        self._subscriptions: dict[int, str] = {}
        self._texts: deque[str] = deque()
        self._data: deque[bytes] = deque(maxlen=MAX_WAITING_MESSAGES)
        self._send(op="serverInfo", name=f"fishd {name}", capabilities=[], sessionId=session)
        self._send(
            op="advertise",
            channels=[
                {
                    "id": number,
                    "topic": topic,
                    "encoding": "json",
                    "schemaName": schema_name(CHANNELS[topic]),
                    "schemaEncoding": "jsonschema",
                    "schema": json_schema(
                        CHANNELS[topic], readings if topic == "tick" else None
                    ).decode(),
                }
                for number, topic in self._topics.items()
            ],
        )

    def add(self, topic: str, t: float, payload: bytes) -> None:
        """Send a message to the subscriptions of its topic; t: its time [s, unix]."""
        nanoseconds = min(max(0, int(t * 1e9)), 2**64 - 1)
        for number, subscribed in self._subscriptions.items():
            if subscribed == topic:
                head = struct.pack("<BIQ", _MESSAGE_DATA, number, nanoseconds)
                self._data.append(head + payload)
                self.wake()

    def take(self) -> Iterable[str | bytes]:
        """Yield the messages that wait, and remove each."""
        while self._texts or self._data:
            yield self._texts.popleft() if self._texts else self._data.popleft()

    def receive(self, message: str) -> None:
        """Subscribe or unsubscribe; answer any other request with a warning."""
        try:
            request = _decode(message.encode("utf-8", "replace"))
        except msgspec.DecodeError:
            self._warn("this is not a message of the protocol")
            return
        if request.op == "subscribe":
            for wanted in request.subscriptions:
                if wanted.channelId not in self._topics or not 0 <= wanted.id < 2**32:
                    self._warn(f"there is no channel {wanted.channelId}")
                elif len(self._subscriptions) < MAX_SUBSCRIPTIONS:
                    self._subscriptions[wanted.id] = self._topics[wanted.channelId]
        elif request.op == "unsubscribe":
            for number in request.subscriptionIds:
                self._subscriptions.pop(number, None)
        else:
            self._warn("fishd can only be read here")

    def _warn(self, message: str) -> None:
        if len(self._texts) < MAX_WAITING_MESSAGES:
            self._send(op="status", level=_WARNING, message=message)

    def _send(self, **message: Any) -> None:
        self._texts.append(msgspec.json.encode(message).decode())
        self.wake()
