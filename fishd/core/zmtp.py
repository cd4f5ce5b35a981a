"""The part of ZeroMQ's protocol, ZMTP 3, that a DEALER needs; only `wait` blocks.

It loads in a tenth of the time of zmq, and has bounds that ZeroMQ lacks: a message is one frame of
a limited size, and no more is read before that message is received. It also counts connections, so
that a message belongs to a known one. The controller `remote` uses it for its agent, and clients
use it for fishd.
"""

import errno
import select
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from typing import Generic, TypeVar

from fishd.core.addresses import Ipc, Tcp, parse

T = TypeVar("T")

_CHUNK = 65536
"""Maximum number of bytes per read."""

_MORE_FLAG, _LONG_FLAG, _COMMAND_FLAG = 1, 2, 4
"""Flags of a frame: others follow, its size has 8 bytes, it is a command."""
_GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)

_VERSION_END = 11
"""End of the version in a greeting; the mechanism follows later."""


def _property(name: bytes, value: bytes) -> bytes:
    return bytes([len(name)]) + name + len(value).to_bytes(4, "big") + value


def _frame(flags: int, payload: bytes) -> bytes:
    size = len(payload)
    if size > 255:
        return bytes([flags | _LONG_FLAG]) + size.to_bytes(8, "big") + payload
    return bytes([flags, size]) + payload


_READY = _frame(
    _COMMAND_FLAG, b"\x05READY" + _property(b"Socket-Type", b"DEALER") + _property(b"Identity", b"")
)


class Dealer(ABC, Generic[T]):
    """DEALER socket that connects to a peer, and reconnects when the connection was lost."""

    RETRY_S = 0.1
    """Time between two attempts to connect [s]."""
    HANDSHAKE_S = 2.0
    """Maximum time until a connection is established and the peer has sent its greeting [s]."""

    def __init__(self, address: str, max_message: int) -> None:
        """Raises ValueError for an invalid address; max_message: size limit of a message [bytes]"""
        self._where = parse(address)
        self._max_message = max_message
        self.connections = 0
        """Number of connections established until the latest `state`."""
        self.bound = False
        """Whether to stay with the peer of this connection, and never reconnect."""
        self.lost = False
        """Whether the connection to that peer was lost."""
        self.problem = ""
        """Why the latest look-up of the name of the peer failed; empty without one."""
        self.needs_key = False
        """Whether the peer has refused a connection without a key."""
        self._socket: socket.socket | None = None
        self._was_cut = False
        """Whether the peer ended the last handshake; then it sends its mechanism, such as CURVE,
        only if it has not received ours yet."""
        self._greeting_taken = False
        self._ready = False
        """Whether the peer has sent its greeting and READY."""
        self._inbox: deque[T] = deque()
        self._received = bytearray()
        self._unsent = b""
        self._next_attempt = 0.0
        self._give_up = 0.0
        """Deadline for the greeting of the peer [s, monotonic]."""
        self._closed = False
        self._poll = select.epoll()
        self._targets: list[tuple[int, object]] | None = None
        """Address families and addresses to connect to; None until they are known."""
        self._look_up()
        self._advance()

    def fileno(self) -> int:
        """Return a descriptor that is readable once `state` may have changed."""
        return self._poll.fileno()

    def state(self) -> tuple[bool, bool]:
        """Return whether a message can be sent, and whether there is one to receive."""
        if not self._closed:
            self._advance()
        return self._ready and not self._unsent, bool(self._inbox)

    def send(self, payload: bytes) -> None:
        """Send a message; only if `state` allows it."""
        try:
            self._write(_frame(0, payload))
        except OSError:
            self._drop()

    def wait(self, seconds: float) -> None:
        """Wait until `state` may have changed, at most for this time [s]."""
        self._poll.poll(self._until_attempt(seconds))

    def _until_attempt(self, seconds: float) -> float:
        """Return the time to wait [s], at most until the next attempt to connect."""
        if self._socket is None:
            seconds = min(seconds, max(1e-3, self._next_attempt - time.monotonic()))
        return seconds

    def close(self, farewell: bytes = b"") -> None:
        """Send a last message, if there is one and the peer accepts it, and disconnect.

        May be called twice.
        """
        if self._closed:
            return
        self._closed = True
        if farewell and self._socket and self._ready and not self._unsent:
            with suppress(OSError):
                self._socket.send(_frame(0, farewell))
                self._socket.shutdown(socket.SHUT_WR)
                # With unread data, the kernel would discard the message.
                while self._socket.recv(_CHUNK):
                    pass
        self._drop()
        self._poll.close()

    def _look_up(self) -> None:
        """Resolve the addresses to connect to; a host name in a thread, since that may block."""
        if isinstance(self._where, Ipc):
            self._targets = [(socket.AF_UNIX, self._where.path)]
            return
        try:
            self._targets = _addresses(self._where, socket.AI_NUMERICHOST)
        except OSError:
            threading.Thread(target=self._look_up_name, name="peer-host", daemon=True).start()

    def _look_up_name(self) -> None:
        assert isinstance(self._where, Tcp)
        while not self._closed and not self._targets:
            try:
                self._targets = _addresses(self._where, 0)
            except (OSError, UnicodeError) as error:
                from fishd.core.names import describe_name_error

                self.problem = describe_name_error(self._where.host, error)
                time.sleep(1.0)

    def _advance(self) -> None:
        """Connect, send, and read one chunk, as far as possible without blocking."""
        now = time.monotonic()
        try:
            if self._socket is None:
                if not self._targets or now < self._next_attempt or (self.bound and self.lost):
                    return
                self._connect(now)
            if not self._ready and now > self._give_up:
                raise ConnectionError
            if self._unsent:
                self._write(b"")
            if not self._inbox:
                self._read()
        except BlockingIOError:
            pass
        except OSError:
            self._drop()

    def _connect(self, now: float) -> None:
        """Start to connect, and queue the greeting."""
        assert self._targets
        family, target = self._targets[0]
        self._targets = self._targets[1:] + self._targets[:1]
        self._next_attempt, self._give_up = now + self.RETRY_S, now + self.HANDSHAKE_S
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        if family != socket.AF_UNIX:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        failure = self._socket.connect_ex(target)  # type: ignore[arg-type]
        if failure not in (0, errno.EINPROGRESS):
            raise ConnectionError  # also where the queue of the peer is full: EAGAIN
        self._unsent = _GREETING[:_VERSION_END] if self._was_cut else _GREETING + _READY
        self._poll.register(self._socket, select.EPOLLIN | select.EPOLLOUT)

    def _write(self, data: bytes) -> None:
        """Send as much as the kernel accepts, and keep the rest."""
        assert self._socket
        was_waiting = bool(self._unsent)
        self._unsent += data
        try:
            self._unsent = self._unsent[self._socket.send(self._unsent) :]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError as error:
            if error.errno != errno.ENOTCONN:  # not connected yet
                raise
        if was_waiting != bool(self._unsent):
            write_event = select.EPOLLOUT if self._unsent else 0
            self._poll.modify(self._socket, select.EPOLLIN | write_event)

    def _read(self) -> None:
        """Read one chunk, and process the complete frames."""
        assert self._socket
        data = self._socket.recv(_CHUNK)
        if not data:
            raise ConnectionResetError
        self._received += data
        if not self._greeting_taken and not self._greeted():
            return
        while frame := self._next_frame():
            flags, payload = frame
            if flags & _COMMAND_FLAG:
                self._obey(payload)
            elif flags & _MORE_FLAG:
                self._refuse("a message of several frames; one frame of JSON is needed")
            else:
                self._inbox.append(self._decode(payload))

    def _greeted(self) -> bool:
        """Return whether the greeting of the peer has arrived; raise ConnectionError if invalid."""
        start, version = bytes(self._received[:1]), bytes(self._received[10:11])
        if start not in (b"", b"\xff") or version not in (b"", b"\x03"):
            raise ConnectionError
        if len(self._received) < len(_GREETING):
            return False
        mechanism = self._received[12:32].rstrip(b"\0")
        if mechanism != b"NULL":
            self.needs_key = mechanism == b"CURVE"
            raise ConnectionError
        if self._was_cut:
            self._write(_GREETING[_VERSION_END:] + _READY)
        del self._received[: len(_GREETING)]
        self._greeting_taken = True
        return True

    def _next_frame(self) -> tuple[int, bytes] | None:
        """Return flags and payload of the next frame, None if incomplete; refuse a long one."""
        if len(self._received) < 2:
            return None
        flags = self._received[0]
        begin = 9 if flags & _LONG_FLAG else 2
        if len(self._received) < begin:
            return None
        size = int.from_bytes(self._received[1:begin], "big")
        if size > self._max_message:
            self._refuse(f"a message of {size} bytes; at most {self._max_message} are permitted")
        if len(self._received) < begin + size:
            return None
        payload = bytes(self._received[begin : begin + size])
        del self._received[: begin + size]
        return flags, payload

    def _obey(self, command: bytes) -> None:
        """Handle a ZMTP command; raise ConnectionError if it ends the connection."""
        name = command[1 : 1 + command[0]] if command else b""
        if name == b"READY" and not self._ready:
            self._ready = True
            self.connections += 1
        elif name == b"PING" and not self._unsent:  # a peer that does not read gets no PONG
            self._write(_frame(_COMMAND_FLAG, b"\x04PONG" + command[7:]))
        elif name == b"ERROR":
            raise ConnectionError

    def _refuse(self, what: str) -> None:
        """Queue an invalid message for the receiver, and raise ConnectionError to disconnect."""
        self._inbox.append(self._bad(what))
        raise ConnectionError

    @abstractmethod
    def _decode(self, payload: bytes) -> T:
        """Return the received object of a message."""

    @abstractmethod
    def _bad(self, what: str) -> T:
        """Return the object received in place of a forbidden message, which `what` describes."""

    def _drop(self) -> None:
        """Close the connection and reset its state."""
        if self._socket is None:
            return
        self._socket.close()  # also removes it from epoll
        self._socket = None
        self.lost = self.lost or self.bound
        self._was_cut = not self._ready and bool(self._received)
        self._ready = self._greeting_taken = False
        self._unsent = b""
        self._received.clear()


def _addresses(where: Tcp, flags: int) -> list[tuple[int, object]]:
    """Resolve a host; raise OSError."""
    family = socket.AF_INET6 if ":" in where.host else socket.AF_INET
    hosts = socket.getaddrinfo(where.host, int(where.port), family, socket.SOCK_STREAM, flags=flags)
    return [(host[0], host[4]) for host in hosts]
