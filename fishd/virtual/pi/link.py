"""Link to a virtual Pi in another process: the messages on its socket, and the client.

Each message is one packet of a Unix socket, encoded as msgpack; each request gets one reply.
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

LONG_POLL_TIMEOUT_S = 0.5
"""Longest time that a request for changed levels waits [s]."""
MAX_PACKET_BYTES = 65536
"""Largest message [bytes]; an I2C transfer of the kernel is shorter."""
ANSWER_MARGIN_S = 1.0
"""Time that the client waits for an answer beyond the timeout of the bus [s]."""


class Call(Struct, frozen=True, array_like=True):
    """Request for one operation of `LinkServer`, by its name."""

    operation: str
    arguments: tuple[Any, ...] = ()


class Done(Struct, frozen=True, tag=True, array_like=True):
    """Reply to a successful request."""

    value: Any = None


class Failed(Struct, frozen=True, tag=True, array_like=True):
    """Reply to a failed request: an error number of the kernel, or 0 for an invalid request."""

    errno: int
    message: str


class RemotePi:
    """Client of a virtual Pi in another process; safe for use from several threads.

    Requests raise OSError ENODEV while the other process is not running, and ETIMEDOUT while it
    hangs. The messages of these errors differ from those of errors of the bus.
    """

    def __init__(self, path: Path) -> None:
        """Connect; raises `StartupError` when no virtual Pi listens at `path`."""
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
            detail = "" if absent else f" ({error.strerror or error})"
            raise StartupError(
                f"no virtual Pi is running at {path}{detail}; start one with "
                "'fishctl virtual-pi run'"
            ) from None

    def transfer(self, address: int, messages: Sequence[Message]) -> list[bytes]:
        """Perform one I2C transfer, and return the bytes of each read; raises OSError."""
        encoded = tuple(m.data if isinstance(m, Write) else m.length for m in messages)
        replies: list[bytes] = self._call("transfer", address, encoded, time.monotonic())
        return replies

    def set_timeout(self, seconds: float) -> None:
        """Set the kernel's timeout for a hanging bus [s], also after a reconnect."""
        self._timeout = seconds
        self._call("set_timeout", seconds)

    def inject(self, name: str, seconds: float | None = None) -> None:
        """Start a fault, for a time [s] or until it is cleared; raises ValueError if unknown."""
        self._call("inject", name, seconds)

    def clear(self, name: str | None = None) -> None:
        """End a fault, or all faults; raises ValueError if unknown."""
        self._call("clear", name)

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive an input pin low or high from outside; None stops driving it."""
        self._call("set_level", gpio, level)

    def await_levels(self, known: dict[int, int]) -> dict[int, int]:
        """Return the pins driven from outside when they differ from `known`, or after a timeout."""
        levels: dict[int, int] = self._call("await_levels", known)
        return levels

    def state(self) -> PiState:
        """Return the state of the virtual Pi."""
        return msgspec.convert(self._call("state"), PiState)

    def close(self) -> None:
        """Disconnect, even while another thread waits; may be called twice."""
        connection = self._socket
        if connection:
            with contextlib.suppress(OSError):  # already disconnected
                connection.shutdown(socket.SHUT_RDWR)
        with self._lock:
            self._hang_up()

    def __enter__(self) -> "RemotePi":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _call(self, operation: str, *arguments: Any) -> Any:
        with self._lock:
            reply = self._exchange(Call(operation, arguments))
        if isinstance(reply, Failed):
            if reply.errno:
                raise OSError(reply.errno, reply.message)
            raise ValueError(reply.message)
        return reply.value

    def _exchange(self, request: Call) -> Done | Failed:
        try:
            connection = self._socket or self._connect()
            connection.settimeout((self._timeout or KERNEL_TIMEOUT) + ANSWER_MARGIN_S)
            connection.send(self._encode(request))
            reply = connection.recv(MAX_PACKET_BYTES)
            if reply:
                answer: Done | Failed = self._decode(reply)
                return answer
        except TimeoutError:  # a late reply must not answer the next request
            self._hang_up()
            raise TimeoutError(errno.ETIMEDOUT, self._describe_failure("does not answer")) from None
        except OSError:
            pass
        self._hang_up()
        raise OSError(errno.ENODEV, self._describe_failure("is gone"))

    def _describe_failure(self, symptom: str) -> str:
        return (
            f"the virtual Pi at {self._path} {symptom}: is 'fishctl virtual-pi run' still running?"
        )

    def _connect(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            connection.settimeout(ANSWER_MARGIN_S)
            connection.connect(str(self._path))
            if self._timeout is not None:
                connection.send(self._encode(Call("set_timeout", (self._timeout,))))
                connection.recv(MAX_PACKET_BYTES)
        except OSError:
            connection.close()
            raise
        self._socket = connection
        return connection

    def _hang_up(self) -> None:
        if self._socket:
            self._socket.close()
            self._socket = None
