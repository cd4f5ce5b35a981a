"""Client of pigpiod with a time limit on every step, and descriptions of its errors."""

import contextlib
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator

import pigpio

from fishd.core.errors import ServoError

ANSWER_TIMEOUT_S = 1.0
"""Longest time for an answer of pigpiod outside of a tick [s]."""

# An impossible host name causes a UnicodeError.
COMMAND_ERRORS = (OSError, pigpio.error, UnicodeError)
"""Exceptions that a command raises."""

MAX_SCRIPTS, SCRIPT_PARAMETERS = 32, 10
"""Number of scripts that pigpiod stores, and of the parameters of each."""

_MAX_VERSION = 9999
"""Largest version that a pigpiod may have; it is 79 since 2021."""
_STANDSTILL_POLL_S = 5e-3
"""Period at which a wait in virtual time checks whether pigpiod stands still [s]."""

UNKNOWN_SCRIPT = pigpio.error_text(pigpio.PI_BAD_SCRIPT_ID)
_SCRIPT_DELETED = "another program deleted fishd's script, as 'fishctl release' does"
_SCRIPT_STATUS = 45
_ANSWER = struct.Struct("<3Ii")


class MissingCommands(ServoError):
    """A pigpiod that is too old for the countdown; the text names its address."""


class SilentServer(TimeoutError):
    """A server has not answered the first request."""


class TimedSocket:
    """Socket with one deadline for all transfers, which assigns late answers to their commands.

    A command without an answer in time ends with TimeoutError. Its number is kept, and its late
    answer is discarded before the answer to a later command is read, so the two are never confused.
    """

    def __init__(
        self, host: str, port: int, limit: float, standstill: Callable[[], bool] | None = None
    ) -> None:
        """Connect within `limit` [s].

        standstill: function that returns, in virtual time, whether no answer can arrive before
            time advances; then no command waits for one
        """
        self._socket = socket.create_connection((host, port), limit)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.deadline = time.monotonic() + limit
        self._standstill = standstill
        self.unanswered: deque[int] = deque()
        """Numbers of the commands that are not answered yet, oldest first."""
        self._received = bytearray()
        self._rest = b""
        """Part of the answer to the latest command that the client has not read yet."""

    def send(self, data: bytes) -> int:
        """Send a command."""
        self.sendall(data)
        return len(data)

    def sendall(self, data: bytes) -> None:
        """Send a longer command; the pigpio module calls this method for it."""
        remaining = self.deadline - time.monotonic()
        if remaining <= 0.0:
            # After such a delay the command may be based on an outdated state: do not send it.
            raise TimeoutError
        self._socket.settimeout(remaining)
        try:
            self._socket.sendall(data)
        except TimeoutError:
            raise ConnectionError("it takes no more commands") from None
        self.unanswered.append(int.from_bytes(data[:4], "little"))
        self._rest = b""

    def recv(self, count: int) -> bytes:
        """Return up to `count` bytes of the answer to the latest command."""
        if not self._rest:
            while len(self.unanswered) > 1:
                self._answer()
            self._rest = self._answer()
        data, self._rest = self._rest[:count], self._rest[count:]
        return data

    def settle(self) -> None:
        """Wait for the answers to all commands."""
        while self.unanswered:
            self._answer()

    @property
    def received(self) -> bytes:
        """Bytes that have arrived and belong to no complete answer."""
        return bytes(self._received)

    def interrupt(self) -> None:
        """End the wait of another thread."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close at once."""
        self.interrupt()
        self._socket.close()

    def _answer(self) -> bytes:
        """Return the complete answer to the oldest command, then count it as answered."""
        self._fill(_ANSWER.size)
        echo, _, _, result = _ANSWER.unpack_from(self._received)
        if echo != self.unanswered[0]:
            raise ConnectionError(
                f"it is not pigpiod: it answers command {echo} instead of {self.unanswered[0]}"
            )
        size = _ANSWER.size + (max(0, result) if echo == _SCRIPT_STATUS else 0)
        self._fill(size)
        answer = bytes(self._received[:size])
        del self._received[:size]
        self.unanswered.popleft()
        return answer

    def _fill(self, size: int) -> None:
        """Wait until `size` bytes have arrived; after the deadline, only read."""
        while len(self._received) < size:
            data = self._receive()
            if not data:
                is_partial = 0 < len(self._received) < _ANSWER.size
                raise ConnectionResetError(
                    "it closed the connection in the middle of an answer"
                    if is_partial
                    else "it closed the connection"
                )
            self._received += data

    def _receive(self) -> bytes:
        """Return the next bytes before the deadline; empty if the connection is closed."""
        while True:
            stands_still = self._standstill is not None and self._standstill()
            remaining = 0.0 if stands_still else max(0.0, self.deadline - time.monotonic())
            self._socket.settimeout(
                min(remaining, _STANDSTILL_POLL_S) if self._standstill else remaining
            )
            try:
                return self._socket.recv(4096)
            except (BlockingIOError, TimeoutError):
                if not self._standstill or not remaining:
                    raise TimeoutError from None


class Client(pigpio.pi):  # type: ignore[misc]
    """Client of module pigpio on one timed socket.

    The constructor of the base class is not called: it hangs on a frozen pigpiod, and opens a
    second connection whose thread spins after pigpiod has ended. fishd needs no notifications.
    """

    refusal = pigpio.error
    """Exception raised if pigpiod refuses a command."""

    def __init__(
        self, host: str, port: int, limit: float, standstill: Callable[[], bool] | None = None
    ) -> None:
        """Connect within `limit` [s]; raise OSError. `standstill` is that of `TimedSocket`."""
        self.place = pigpiod_at(host, port)
        """Name of this pigpiod in messages."""
        self._notify = None
        self._socket = TimedSocket(host, port, limit, standstill)
        self.sl = pigpio._socklock()
        self.sl.s = self._socket
        self.connected = True

    def identify(self) -> int:
        """Return the version of pigpiod; raise OSError, also for another server."""
        try:
            version = int(self.get_pigpio_version())
        except TimeoutError:
            raise SilentServer from None
        except ConnectionError:
            if self._socket.received:
                raise
            raise ConnectionError(
                "it closed the connection at once: it is not pigpiod, or its option -n does not "
                "permit this address"
            ) from None
        if not 0 < version <= _MAX_VERSION:  # 0 is sent by a server that returns what it receives
            raise ConnectionError(f"it is not pigpiod: it says that its version is {version}")
        return version

    @property
    def unanswered(self) -> int:
        """Number of commands that are not answered yet."""
        return len(self._socket.unanswered)

    def settle(self) -> None:
        """Wait for the answers to all commands."""
        self._socket.settle()

    def within(self, seconds: float) -> None:
        """Set the deadline of all commands until the next call to `seconds` from now."""
        self._socket.deadline = time.monotonic() + seconds

    def interrupt(self) -> None:
        """Make the command fail for which another thread waits."""
        self._socket.interrupt()

    def close(self) -> None:
        """Close the connection at once; may be called twice."""
        self.connected = False
        self._socket.close()


def pigpiod_at(host: str, port: int) -> str:
    """Return the name of this pigpiod in messages."""
    return f"pigpiod at {host}:{port}"


def describe_error(error: BaseException, limit: float) -> str:
    """Return what went wrong as a short text; `limit` is the time that pigpiod had [s]."""
    if isinstance(error, TimeoutError):
        silence = f"no answer within {limit * 1e3:g} ms"
        is_first = isinstance(error, SilentServer)
        return f"{silence}: it is not pigpiod, or it hangs" if is_first else silence
    if isinstance(error, pigpio.error):
        return _SCRIPT_DELETED if error.value == UNKNOWN_SCRIPT else str(error.value)
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


@contextlib.contextmanager
def open_client(host: str, port: int, limit: float = ANSWER_TIMEOUT_S) -> Iterator[Client]:
    """Return a client for a few commands, each `within` or all within `limit` [s].

    Raises `ServoError` with one line for every error inside the context.
    """
    client = None
    try:
        client = Client(host, port, limit)
        client.identify()
        client.within(limit)
        yield client
    except MissingCommands:
        raise
    except COMMAND_ERRORS as error:
        raise ServoError(f"{pigpiod_at(host, port)}: {describe_error(error, limit)}") from None
    finally:
        if client:
            client.close()
