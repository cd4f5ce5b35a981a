"""The messages between fishd and its gateways, over a SOCK_SEQPACKET socket."""

import socket
from collections.abc import Iterator

LONGEST = 65536
"""Of a message on a link [bytes]; longer ones travel in parts."""

TELEMETRY, CONTROL = "telemetry", "control"
"""The kinds of gateways."""

REQUEST, READY, NOTICE, END = b"?", b"^", b"!", b"."
"""First bytes: a client's request, that a gateway serves from now on, why it ends, and that fishd
does."""
PING, PONG = b"~", b"-"
"""First bytes of a heartbeat and of the answer to it."""
START, STARTED = b"*", b"/"
"""First bytes of a request to the fork server for a gateway, and of the answer to it."""
_PART, _LAST = b"+", b"="

_HEAD = 9


def pair() -> tuple[socket.socket, socket.socket]:
    """The two ends of a link; neither ever blocks."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
    return ends


def start(kind: str, address: str) -> bytes:
    """Return a request for a gateway; its link and its listener go with it."""
    return START + f"{kind} {address}".encode()


def kind_and_address(message: bytes) -> tuple[str, str]:
    """Return what a request for a gateway names."""
    kind, _, address = message[1:].decode().partition(" ")
    return kind, address


def started(kind: str, outcome: str) -> bytes:
    """Return the answer to a request for a gateway.

    outcome: how the gateway before it ended, or why this one could not be started, in words
    """
    return STARTED + f"{kind} {outcome}".encode()


def kind_and_outcome(message: bytes) -> tuple[str, str]:
    """Return what the answer to a request for a gateway says."""
    return kind_and_address(message)


def published(topic: bytes, payload: bytes) -> bytes:
    """A message for subscribers."""
    return topic + b"\0" + payload


def frames(message: bytes) -> list[bytes]:
    """The two frames of a published message."""
    return message.split(b"\0", 1)


def request(number: int, payload: bytes) -> bytes:
    """A client's request; replies to it carry the same number.

    number: when it came [ns, monotonic], another one for each
    """
    return REQUEST + number.to_bytes(8, "big") + payload


def numbered(message: bytes) -> tuple[int, bytes]:
    """Number and payload of a request."""
    return int.from_bytes(message[1:_HEAD], "big"), message[_HEAD:]


def reply(number: int, payload: bytes) -> Iterator[bytes]:
    """The messages that carry a reply."""
    head = number.to_bytes(8, "big")
    size = LONGEST - _HEAD
    for begin in range(0, max(1, len(payload)), size):
        last = begin + size >= len(payload)
        yield (_LAST if last else _PART) + head + payload[begin : begin + size]


class Replies:
    """Puts the parts of replies together."""

    def __init__(self) -> None:
        self._parts: dict[int, list[bytes]] = {}

    def take(self, message: bytes) -> tuple[int, bytes] | None:
        """Number and payload of a reply that is complete with this message; None before that."""
        number, part = numbered(message)
        parts = self._parts.setdefault(number, [])
        parts.append(part)
        if message[:1] != _LAST:
            return None
        del self._parts[number]
        return number, b"".join(parts)
