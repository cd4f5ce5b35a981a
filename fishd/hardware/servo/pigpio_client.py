"""The pigpio client with a time limit on everything, and words for what fails in it."""

import contextlib
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator

import pigpio

from fishd.core.errors import ServoError

ANSWER = 1.0
"""How long pigpiod may take to answer outside of a tick [s]."""

# A host name that cannot be one is a UnicodeError.
FAILURES = (OSError, pigpio.error, UnicodeError)
"""What a command raises."""

SCRIPTS, PARAMETERS = 32, 10

_LOOK = 5e-3
"""How often somebody who waits in virtual time looks whether pigpiod stands still [s]."""

UNKNOWN_SCRIPT = pigpio.error_text(pigpio.PI_BAD_SCRIPT_ID)
_TAKEN_AWAY = "somebody else took fishd's script away, as 'fishctl release' does"
_SCRIPT_STATUS = 45
_ANSWER = struct.Struct("<3Ii")


class TimedSocket:
    """A socket with one deadline for all that goes through it, which tells late answers apart.

    A command whose answer does not come in time ends with TimeoutError. That answer is owed from
    then on, and is left out before the one to a later command: none is taken for that of another.
    """

    def __init__(
        self, host: str, port: int, limit: float, standstill: Callable[[], bool] | None = None
    ) -> None:
        """standstill: in virtual time, whether no answer can come before time moves on; nobody
        waits for one then
        """
        self._socket = socket.create_connection((host, port), limit)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.deadline = time.monotonic() + limit
        self._standstill = standstill
        self.owed: deque[int] = deque()
        """Numbers of the commands that are not answered yet."""
        self._received = bytearray()
        self._rest = b""
        """What the client has not read yet of the answer to its command."""

    def send(self, data: bytes) -> int:
        """Send a command."""
        self.sendall(data)
        return len(data)

    def sendall(self, data: bytes) -> None:
        """The same, as the client calls it for a longer one."""
        remaining = self.deadline - time.monotonic()
        if remaining <= 0.0:
            # Held up for so long, what comes now may rest upon what is over: it is not sent.
            raise TimeoutError
        self._socket.settimeout(remaining)
        try:
            self._socket.sendall(data)
        except TimeoutError:
            raise ConnectionError("it takes no more commands") from None
        self.owed.append(int.from_bytes(data[:4], "little"))
        self._rest = b""

    def recv(self, count: int) -> bytes:
        """Up to `count` bytes of the answer to the latest command."""
        if not self._rest:
            while len(self.owed) > 1:
                self._answer()
            self._rest = self._answer()
        data, self._rest = self._rest[:count], self._rest[count:]
        return data

    def settle(self) -> None:
        """Wait for all answers that are owed."""
        while self.owed:
            self._answer()

    def interrupt(self) -> None:
        """End whatever another thread is waiting for."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close at once."""
        self.interrupt()
        self._socket.close()

    def _answer(self) -> bytes:
        """The answer to the oldest command, with what follows it; stays owed until it is whole."""
        self._fill(_ANSWER.size)
        echo, _, _, result = _ANSWER.unpack_from(self._received)
        if echo != self.owed[0]:
            raise ConnectionError(f"it answers command {echo} instead of {self.owed[0]}")
        size = _ANSWER.size + (max(0, result) if echo == _SCRIPT_STATUS else 0)
        self._fill(size)
        answer = bytes(self._received[:size])
        del self._received[:size]
        self.owed.popleft()
        return answer

    def _fill(self, size: int) -> None:
        """Wait until so many bytes have come; what is there already is taken at any time."""
        while len(self._received) < size:
            data = self._receive()
            if not data:
                within = 0 < len(self._received) < _ANSWER.size
                raise ConnectionResetError(
                    "it broke off in mid-answer" if within else "it closed the connection"
                )
            self._received += data

    def _receive(self) -> bytes:
        """What comes next before the deadline; empty where the connection is closed."""
        while True:
            still = self._standstill is not None and self._standstill()
            remaining = 0.0 if still else max(0.0, self.deadline - time.monotonic())
            self._socket.settimeout(min(remaining, _LOOK) if self._standstill else remaining)
            try:
                return self._socket.recv(4096)
            except (BlockingIOError, TimeoutError):
                if not self._standstill or not remaining:
                    raise TimeoutError from None


class Client(pigpio.pi):  # type: ignore[misc]
    """The pigpio client on one timed socket.

    Its own constructor is passed over: that one hangs on a frozen pigpiod, and opens a second
    connection whose thread spins once pigpiod is gone. fishd needs no notifications.
    """

    refusal = pigpio.error
    """Raised where pigpiod does not do what a command asks for."""

    def __init__(
        self, host: str, port: int, limit: float, standstill: Callable[[], bool] | None = None
    ) -> None:
        """Connect within `limit` [s]; raises OSError. `standstill`: as for `TimedSocket`."""
        self._host, self._port = host, port
        self._notify = None
        self._socket = TimedSocket(host, port, limit, standstill)
        self.sl = pigpio._socklock()
        self.sl.s = self._socket
        self.connected = True

    @property
    def owed(self) -> int:
        """How many answers have not come yet."""
        return len(self._socket.owed)

    def settle(self) -> None:
        """Wait for the answers that are owed."""
        self._socket.settle()

    def within(self, seconds: float) -> None:
        """All commands from here to the next call must be answered within `seconds` from now."""
        self._socket.deadline = time.monotonic() + seconds

    def interrupt(self) -> None:
        """Make the command that another thread waits for fail."""
        self._socket.interrupt()

    def close(self) -> None:
        """Close the connection at once; may be called twice."""
        self.connected = False
        self._socket.close()


def where(host: str, port: int) -> str:
    """How messages name this pigpiod."""
    return f"pigpiod at {host}:{port}"


def reason(error: BaseException, limit: float) -> str:
    """What went wrong, in a few words; `limit` is the time that pigpiod had [s]."""
    if isinstance(error, TimeoutError):
        return f"no answer within {limit * 1e3:g} ms"
    if isinstance(error, pigpio.error):
        return _TAKEN_AWAY if error.value == UNKNOWN_SCRIPT else str(error.value)
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


@contextlib.contextmanager
def opened(host: str, port: int, limit: float = ANSWER) -> Iterator[Client]:
    """A client for a few commands, each `within` or all within `limit` [s].

    Raises `ServoError` with one line for whatever fails inside.
    """
    client = None
    try:
        client = Client(host, port, limit)
        yield client
    except FAILURES as error:
        raise ServoError(f"{where(host, port)}: {reason(error, limit)}") from None
    finally:
        if client:
            client.close()
