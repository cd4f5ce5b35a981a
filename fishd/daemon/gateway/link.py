"""Messages between fishd and its gateways, over a SOCK_SEQPACKET socket."""

import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import zmq

MAX_MESSAGE_BYTES = 65536
"""Largest size of a message on a link [bytes]; longer replies are sent in parts."""

TELEMETRY, CONTROL = "telemetry", "control"
KEYED_TELEMETRY, KEYED_CONTROL = "keyed-telemetry", "keyed-control"
"""Kinds of gateways; only clients with a known key connect to the latter two."""

REQUEST, READY, NOTICE, END = b"?", b"^", b"!", b"."
"""First bytes of a client's request, of the start and the end of a gateway, and of fishd's end; a
start may name a mistake in the file of known keys."""
PING, PONG = b"~", b"-"
"""First bytes of a heartbeat and of the answer to it."""
LISTEN = b"@"
"""First byte of a further address to listen at; its listener is sent with it."""
MAX_FORMER_LISTENERS = 16
"""Largest number of further listeners of a gateway."""
_former_listeners: list[str] = []
"""Addresses of the further listeners of this process."""
START, STARTED = b"*", b"/"
"""First bytes of a request to the fork server for a gateway, and of the answer to it."""
_PART, _LAST = b"+", b"="

_HEAD_BYTES = 9


def pair() -> tuple[socket.socket, socket.socket]:
    """Return the two ends of a link, both non-blocking."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
    return ends


def start(kind: str, address: str) -> bytes:
    """Return a request for a gateway; its link and its listener are sent with it."""
    return START + f"{kind} {address}".encode()


def kind_and_address(message: bytes) -> tuple[str, str]:
    """Return the kind and the address in a request for a gateway."""
    kind, _, address = message[1:].decode().partition(" ")
    return kind, address


def listen(server: "zmq.Socket[bytes]", message: bytes, listener: int) -> None:
    """Let a gateway's socket listen at the address in a message, too; `listener` is its socket.

    Connections end with the listener through which they came, so former ones are kept, but no more
    than `MAX_FORMER_LISTENERS`: then all connections end, and clients connect again.
    """
    import zmq

    if len(_former_listeners) >= MAX_FORMER_LISTENERS:
        for address in set(_former_listeners):  # `unbind` closes all listeners of an address
            server.unbind(address)
        _former_listeners.clear()
    server.set(zmq.USE_FD, listener)
    server.bind(message[1:].decode())
    bound = server.get(zmq.LAST_ENDPOINT)
    assert isinstance(bound, bytes)
    _former_listeners.append(bound.rstrip(b"\0").decode())


def started(kind: str, pid: int, outcome: str) -> bytes:
    """Return the answer to a request for a gateway.

    pid: number of its process; 0 if it could not be started
    outcome: text on how the previous gateway ended, or why this one could not be started
    """
    return STARTED + f"{kind} {pid} {outcome}".encode()


def read_started(message: bytes) -> tuple[str, int, str]:
    """Return kind, number of the process and outcome in the answer to a request for a gateway."""
    kind, pid, outcome = message[1:].decode().split(" ", 2)
    return kind, int(pid), outcome


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
