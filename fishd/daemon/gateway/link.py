"""Messages between fishd and a gateway, over a SOCK_SEQPACKET socket."""

import socket
from collections.abc import Iterator

MAX_MESSAGE_BYTES = 65536
"""Largest size of a message on a link [bytes]; longer replies are sent in parts."""
MAX_TELEMETRY_BYTES = 2**20
"""Largest size of a message for subscribers [bytes]."""

TELEMETRY, CONTROL = "telemetry", "control"
"""Kinds of sockets."""

REQUEST, READY, TICKS = b"?", b"^", b"%"
"""First bytes of messages from a gateway: a client's request; that it serves; whether ticks have
subscribers."""
EXCEEDED, CLOSED = b"!", b"x"
"""First bytes of a limit for which the gateway starts again, and of a change of the keys for which
it has closed the socket of telemetry."""
PING, PONG = b"~", b"-"
"""A heartbeat, and the answer to it."""
LISTEN = b"@"
"""First byte of an address to listen at, which comes with its listener."""
_PART, _LAST = b"+", b"="

_HEAD_BYTES = 9


def pair() -> tuple[socket.socket, socket.socket]:
    """Return the two ends of a link, both non-blocking."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
    return ends


def listen(kind: str, address: str, keys: str) -> bytes:
    """Return the message that lets a gateway listen; the listener is sent with it.

    keys: secret key and folder of the keys; empty for a socket without keys
    """
    return LISTEN + f"{kind} {address} {keys}".encode()


def read_listen(message: bytes) -> tuple[str, str, str]:
    """Return kind, address and keys in a message of `listen`."""
    kind, address, keys = message[1:].decode().split(" ", 2)
    return kind, address, keys


def join_frames(topic: bytes, payload: bytes) -> bytes:
    """Return a message for subscribers."""
    return topic + b"\0" + payload


def split_frames(message: bytes) -> list[bytes]:
    """Return the two frames of a message for subscribers."""
    return message.split(b"\0", 1)


def request(number: int, payload: bytes) -> bytes:
    """Return the message with a client's request; the reply has the same number.

    number: time when the request arrived [ns, monotonic], unique
    """
    return REQUEST + number.to_bytes(8, "big") + payload


def number_and_payload(message: bytes) -> tuple[int, bytes]:
    """Return the number and the payload of a request or a reply."""
    return int.from_bytes(message[1:_HEAD_BYTES], "big"), message[_HEAD_BYTES:]


def reply(number: int, payload: bytes) -> Iterator[bytes]:
    """Yield the messages that carry a reply."""
    head = number.to_bytes(8, "big")
    size = MAX_MESSAGE_BYTES - _HEAD_BYTES
    for start in range(0, max(1, len(payload)), size):
        is_last = start + size >= len(payload)
        yield (_LAST if is_last else _PART) + head + payload[start : start + size]


def is_reply(message: bytes) -> bool:
    """Return whether a message carries a reply, or a part of one."""
    return message[:1] in (_PART, _LAST)


class Replies:
    """Assembler of the parts of replies."""

    def __init__(self) -> None:
        self._parts: dict[int, list[bytes]] = {}

    def take(self, message: bytes) -> tuple[int, bytes] | None:
        """Return number and payload of a reply that this message completes, else None."""
        number, part = number_and_payload(message)
        parts = self._parts.setdefault(number, [])
        parts.append(part)
        if message[:1] != _LAST:
            return None
        del self._parts[number]
        return number, b"".join(parts)
