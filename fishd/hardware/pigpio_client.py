"""The pigpio client with a time limit on everything, and words for what fails in it."""

import contextlib
import socket
import struct
import time
from collections.abc import Iterator

import pigpio

from fishd.errors import ServoError
from fishd.hardware.settings import PigpioSettings

ANSWER = 1.0
"""How long pigpiod may take to answer outside of a tick [s]."""

# A host name that cannot be one is a UnicodeError.
FAILURES = (OSError, struct.error, pigpio.error, UnicodeError)
"""What a command raises; the client is then good for nothing more."""


_UNKNOWN_SCRIPT = pigpio.error_text(pigpio.PI_BAD_SCRIPT_ID)
_TAKEN_AWAY = "somebody else took fishd's script away, as 'fishctl release' does"


class TimedSocket:
    """A socket with one deadline for all that goes through it, and an error where others end."""

    def __init__(self, host: str, port: int, limit: float) -> None:
        self._socket = socket.create_connection((host, port), limit)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.deadline = time.monotonic() + limit

    def _remaining(self) -> float:
        remaining = self.deadline - time.monotonic()
        if remaining <= 0.0:
            raise TimeoutError
        return remaining

    def send(self, data: bytes) -> int:
        """Send what fits."""
        self._socket.settimeout(self._remaining())
        return self._socket.send(data)

    def sendall(self, data: bytes) -> None:
        """Send it all."""
        self._socket.settimeout(self._remaining())
        self._socket.sendall(data)

    def recv(self, count: int) -> bytes:
        """Up to `count` bytes; the client would ask for ever at the end of the stream."""
        self._socket.settimeout(self._remaining())
        data = self._socket.recv(count)
        if not data:
            raise ConnectionResetError("it closed the connection")
        return data

    def interrupt(self) -> None:
        """End whatever another thread is waiting for."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close at once."""
        self.interrupt()
        self._socket.close()


class Client(pigpio.pi):  # type: ignore[misc]
    """The pigpio client on one timed socket.

    Its own constructor is passed over: that one hangs on a frozen pigpiod, and opens a second
    connection whose thread spins once pigpiod is gone. fishd needs no notifications.
    """

    def __init__(self, host: str, port: int, limit: float) -> None:
        """Connect within `limit` [s]; raises OSError."""
        self._host, self._port = host, port
        self._notify = None
        self._socket = TimedSocket(host, port, limit)
        self.sl = pigpio._socklock()
        self.sl.s = self._socket
        self.connected = True

    def within(self, seconds: float) -> None:
        """All commands from here to the next call must be answered within `seconds` from now."""
        self._socket.deadline = time.monotonic() + seconds

    def interrupt(self) -> None:
        """Make the command that another thread waits for fail."""
        self._socket.interrupt()

    def dispose(self) -> None:
        """Close the connection, so that a late answer meets no command; may be called twice."""
        self.connected = False
        self._socket.close()


def where(settings: PigpioSettings) -> str:
    """How messages name this pigpiod."""
    return f"pigpiod at {settings.host}:{settings.port}"


def reason(error: BaseException, limit: float) -> str:
    """What went wrong, in a few words; `limit` is the time that pigpiod had [s]."""
    if isinstance(error, TimeoutError):
        return f"no answer within {limit * 1e3:g} ms"
    if isinstance(error, struct.error):
        return "it broke off in mid-answer"
    if isinstance(error, pigpio.error):
        return _TAKEN_AWAY if error.value == _UNKNOWN_SCRIPT else str(error.value)
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


@contextlib.contextmanager
def opened(settings: PigpioSettings, limit: float = ANSWER) -> Iterator[Client]:
    """A client for a few commands, each `within` or all within `limit` [s].

    Raises `ServoError` with one line for whatever fails inside.
    """
    client = None
    try:
        client = Client(settings.host, settings.port, limit)
        yield client
    except FAILURES as error:
        raise ServoError(f"{where(settings)}: {reason(error, limit)}") from None
    finally:
        if client:
            client.dispose()
