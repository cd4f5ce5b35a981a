"""The link to a virtual Pi in another process: the messages on its socket, and the client.

Each message is one packet of a Unix socket, msgpack inside; each request gets one reply.
"""

import contextlib
import errno
import socket
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from fishd.core.errors import StartupError
from fishd.virtual.pi.i2c import KERNEL_TIMEOUT, Message, Write
from fishd.virtual.pi.virtual_pi import PiState

LONG_POLL = 0.5
"""How long a request for a change waits for one [s]."""
PACKET = 65536
"""Longest message [bytes]; an I2C transfer of the kernel is shorter."""
PATIENCE = 1.0
"""How much longer than the bus may take the client waits for an answer [s]."""


class Request(Struct, frozen=True, tag=True, array_like=True):
    """Root of what can be asked."""


class Transfer(Request, frozen=True):
    """One I2C transfer; answered with the bytes of each read."""

    address: int
    messages: tuple[bytes | int, ...]
    """Bytes to write, or the number of bytes to read."""
    asked: float
    """When [s, monotonic]."""


class SetTimeout(Request, frozen=True):
    """How long the kernel waits for a bus that hangs [s]."""

    seconds: float


class Inject(Request, frozen=True):
    """Let a fault begin."""

    name: str
    seconds: float | None


class Clear(Request, frozen=True):
    """End a fault; None: all."""

    name: str | None


class SetLevel(Request, frozen=True):
    """What is wired to an input pin drives it low or high; None: nothing does."""

    gpio: int
    level: int | None


class AwaitLevels(Request, frozen=True):
    """Answered with the pins driven from outside, as soon as they are other than `known`."""

    known: dict[int, int]


class GetState(Request, frozen=True):
    """Answered with a `PiState`."""


class Done(Struct, frozen=True, tag=True, array_like=True):
    """The reply to a request that was carried out."""

    value: Any = None


class Failed(Struct, frozen=True, tag=True, array_like=True):
    """The reply to a request that failed: an error of the kernel, or 0 for a bad request."""

    errno: int
    message: str


AnyRequest = Transfer | SetTimeout | Inject | Clear | SetLevel | AwaitLevels | GetState


class RemotePi:
    """A virtual Pi in another process; safe for use from several threads.

    Where the other process ends, requests raise OSError ENODEV until there is one again, and
    ETIMEDOUT where it hangs; unlike an error of the bus, these say so in words of their own.
    """

    def __init__(self, path: Path) -> None:
        """Raises `StartupError` when no virtual Pi listens at `path`."""
        self._path = path
        self._timeout: float | None = None
        self._socket: socket.socket | None = None
        self._lock = threading.Lock()
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(Done | Failed).decode
        try:
            self._connect()
        except OSError as error:
            absent = isinstance(error, FileNotFoundError | ConnectionRefusedError)
            why = "" if absent else f" ({error.strerror or error})"
            raise StartupError(
                f"no virtual Pi is running at {path}{why}; start one with 'fishctl virtual-pi run'"
            ) from None

    def transfer(self, address: int, messages: Sequence[Message]) -> list[bytes]:
        """Carry out one I2C transfer; the bytes of each read. Raises OSError as the kernel does."""
        spoken = tuple(m.data if isinstance(m, Write) else m.length for m in messages)
        replies: list[bytes] = self._ask(Transfer(address, spoken, time.monotonic()))
        return replies

    def set_timeout(self, seconds: float) -> None:
        """How long the kernel waits for a bus that hangs [s]; holds for later processes too."""
        self._timeout = seconds
        self._ask(SetTimeout(seconds))

    def inject(self, name: str, seconds: float | None = None) -> None:
        """Let a fault begin, for a while [s] or until it is cleared; ValueError if unknown."""
        self._ask(Inject(name, seconds))

    def clear(self, name: str | None = None) -> None:
        """End a fault, or all of them; ValueError if unknown."""
        self._ask(Clear(name))

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive an input pin low or high from outside; None lets go of it."""
        self._ask(SetLevel(gpio, level))

    def await_levels(self, known: dict[int, int]) -> dict[int, int]:
        """The pins driven from outside, once they are other than `known`, or after a while."""
        levels: dict[int, int] = self._ask(AwaitLevels(known))
        return levels

    def state(self) -> PiState:
        """What the virtual Pi is doing."""
        return msgspec.convert(self._ask(GetState()), PiState)

    def close(self) -> None:
        """Hang up, whatever another thread is waiting for; may be called twice."""
        connection = self._socket
        if connection:
            with contextlib.suppress(OSError):  # it has gone by itself
                connection.shutdown(socket.SHUT_RDWR)
        with self._lock:
            self._hang_up()

    def __enter__(self) -> "RemotePi":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, request: Request) -> Any:
        with self._lock:
            reply = self._exchange(request)
        if isinstance(reply, Failed):
            if reply.errno:
                raise OSError(reply.errno, reply.message)
            raise ValueError(reply.message)
        return reply.value

    def _exchange(self, request: Request) -> Done | Failed:
        try:
            connection = self._socket or self._connect()
            connection.settimeout((self._timeout or KERNEL_TIMEOUT) + PATIENCE)
            connection.send(self._encode(request))
            reply = connection.recv(PACKET)
            if reply:
                answer: Done | Failed = self._decode(reply)
                return answer
        except TimeoutError:  # its reply, if it comes late, must not answer the next request
            self._hang_up()
            raise TimeoutError(errno.ETIMEDOUT, self._words("does not answer")) from None
        except OSError:
            pass
        self._hang_up()
        raise OSError(errno.ENODEV, self._words("is gone"))

    def _words(self, what: str) -> str:
        return f"the virtual Pi at {self._path} {what}: is 'fishctl virtual-pi run' still running?"

    def _connect(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.settimeout(PATIENCE)
            connection.connect(str(self._path))
            if self._timeout is not None:
                connection.send(self._encode(SetTimeout(self._timeout)))
                connection.recv(PACKET)
        except OSError:
            connection.close()
            raise
        self._socket = connection
        return connection

    def _hang_up(self) -> None:
        if self._socket:
            self._socket.close()
            self._socket = None
