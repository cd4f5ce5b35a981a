"""Open pages of a fish: what they are sent, and which of them drives."""

import time
from collections import deque
from collections.abc import Iterable

import msgspec
from aiohttp import WSMsgType

from fishd.window.viewer import Viewer

MAX_TICK_MESSAGES = 40
"""Number of messages with ticks that wait for a slow page; it misses the older ones."""
MAX_MESSAGES = 500
"""Number of all messages that wait; above it, the page is closed."""
DRIVER_TIMEOUT_S = 10.0
"""Time without a sign of life after which a page no longer drives [s]."""


class LivePage(Viewer):
    """One open page."""

    OPCODE = WSMsgType.TEXT

    def __init__(self, client: str, fish: str, device: str, device_id: str) -> None:
        """
        client: identifier of this page
        fish: name of the fish that it shows
        device, device_id: name and id of the device; an empty id for a browser of this machine
        """
        super().__init__()
        self.client, self.fish, self.device, self.device_id = client, fish, device, device_id
        self.seen = time.monotonic()
        """Time of the last sign of life [s, monotonic]."""
        self._messages: deque[tuple[str, bytes]] = deque()

    def push(self, kind: str, message: bytes) -> None:
        """Send a message; a slow page misses ticks, and gets only the newest status."""
        waiting = [place for place, (other, _) in enumerate(self._messages) if other == kind]
        if waiting and (
            kind in ("status", "connection") or (kind, len(waiting)) == ("ticks", MAX_TICK_MESSAGES)
        ):
            del self._messages[waiting[0]]
        self._messages.append((kind, message))
        if len(self._messages) > MAX_MESSAGES:
            self.end()
        self.wake()

    def take(self) -> Iterable[bytes]:
        """Yield the messages that wait, and remove each."""
        while self._messages:
            yield self._messages.popleft()[1]

    def receive(self, message: str) -> None:
        """Note the sign of life; other messages are ignored."""
        if message.startswith('["seen"'):
            self.seen = time.monotonic()


class Driver:
    """The page that drives a fish, also while its connection is interrupted."""

    def __init__(self, page: LivePage, keep: bool) -> None:
        """keep: whether the fish swims on when the page is gone"""
        self.page, self.keep = page, keep

    @property
    def is_gone(self) -> bool:
        """Whether the page has given no sign of life for too long."""
        return time.monotonic() - self.page.seen > DRIVER_TIMEOUT_S

    def describe_to(self, page: LivePage) -> dict[str, object]:
        """Return the description of the driver for a page."""
        mine = page.client == self.page.client
        return {"client": self.page.client, "device": self.page.device, "you_drive": mine}


def encode_message(kind: str, payload: bytes) -> bytes:
    """Return a message for a page: a JSON array of its type and its payload."""
    return b'["%s",%s]' % (kind.encode(), payload)


def encode(value: object) -> bytes:
    """Return a value as JSON."""
    return msgspec.json.encode(value)
