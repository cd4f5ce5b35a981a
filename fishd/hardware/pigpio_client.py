"""pigpiod's protocol with a time limit on everything, and words for what fails in it.

Needs nothing but the standard library: `fishd.release` has to load it quickly.
"""

import contextlib
import socket
import struct
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

from fishd.errors import ServoError

ANSWER = 1.0
"""How long pigpiod may take to answer outside of a tick [s]."""

# A host name that cannot be one is a UnicodeError.
FAILURES = (OSError, UnicodeError)
"""What a command raises."""

GET_MODE, READ, SERVO, VERSION = 1, 3, 8, 26
STORE_SCRIPT, DELETE_SCRIPT, RUN_SCRIPT, SCRIPT_STATUS, UPDATE_SCRIPT = 38, 39, 40, 45, 117
GET_DUTY, GET_WIDTH = 83, 84
INITIALISING = 0
"""Status of a script that cannot be run yet."""
SCRIPTS, PARAMETERS = 32, 10

NOT_PWM, NOT_SERVO, UNKNOWN_SCRIPT = -92, -93, -48
_WORDS = {
    -41: "no permission to update GPIO",
    UNKNOWN_SCRIPT: "somebody else took fishd's script away, as 'fishctl release' does",
    -57: "no room for scripts",
}
_REQUEST = struct.Struct("<4I")
_ANSWER = struct.Struct("<3Ii")
_STATUS = struct.Struct(f"<{PARAMETERS + 1}i")


class Place(Protocol):
    """Where a pigpiod is; `servo.pigpio` of the configuration is one."""

    @property
    def host(self) -> str:
        """Its name or address."""

    @property
    def port(self) -> int:
        """Its TCP port."""


class PigpioError(OSError):
    """Pigpiod has answered with an error; `number` is its own one."""

    def __init__(self, number: int) -> None:
        super().__init__(_WORDS.get(number, f"pigpiod's error {number}"))
        self.number = number


class Answer(NamedTuple):
    """What pigpiod answered: a result, negative for an error, and the bytes that follow it."""

    result: int
    following: bytes

    def good(self) -> int:
        """The result; raises `PigpioError` for an error."""
        if self.result < 0:
            raise PigpioError(self.result)
        return self.result


def request(number: int, p1: int = 0, p2: int = 0, extension: bytes = b"") -> bytes:
    """A command as it is sent."""
    return _REQUEST.pack(number, p1, p2, len(extension)) + extension


def servo(gpio: int, width: float) -> bytes:
    """The request for pulses of this width [µs]; 0 lets the running pulse end, and is the last."""
    return request(SERVO, gpio, round(width))


def update_script(script: int, parameters: Sequence[int]) -> bytes:
    """The request that overwrites the first parameters of a script."""
    return request(UPDATE_SCRIPT, script, 0, _packed(parameters))


class Client:
    """A connection to pigpiod.

    Where a method ends with TimeoutError, the answers that are owed come later, each before those
    to what is asked then; so none is ever taken for that of another command.
    """

    def __init__(self, host: str, port: int, limit: float) -> None:
        """Connect within `limit` [s]; raises OSError."""
        self._socket = socket.create_connection((host, port), limit)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._deadline = time.monotonic() + limit
        self._received = bytearray()
        self._owed: deque[int] = deque()

    @property
    def owed(self) -> int:
        """How many answers have not come yet."""
        return len(self._owed)

    def within(self, seconds: float) -> None:
        """All commands from here to the next call must be answered within `seconds` from now."""
        self._deadline = time.monotonic() + seconds

    def settle(self) -> list[Answer]:
        """Wait for the answers that are owed, and give them."""
        answers = []
        while self._owed:
            answers.append(self._receive(self._owed[0]))
            self._owed.popleft()
        return answers

    def exchange(self, requests: Sequence[bytes], *, urgent: bool = False) -> list[Answer]:
        """Send requests together, and wait for the answer to each.

        urgent: send them though earlier answers are still owed
        """
        if not urgent:
            self.settle()
        self._send(b"".join(requests))
        self._owed.extend(_REQUEST.unpack_from(each)[0] for each in requests)
        return self.settle()[-len(requests) :]

    def ask(self, number: int, p1: int = 0, p2: int = 0, extension: bytes = b"") -> int:
        """Carry out a command; its result. Raises `PigpioError`."""
        return self.exchange([request(number, p1, p2, extension)])[0].good()

    def version(self) -> int:
        """Pigpiod's version."""
        return self.ask(VERSION)

    def servo(self, gpio: int, width: float) -> None:
        """Servo pulses [µs]; 0 lets the running pulse end, and is the last."""
        self.exchange([servo(gpio, width)])[0].good()

    def update_script(self, script: int, parameters: Sequence[int]) -> None:
        """Overwrite the first parameters of a script, whether it runs or not."""
        self.exchange([update_script(script, parameters)])[0].good()

    def store_script(self, text: bytes) -> int:
        """Store a script; its number."""
        return self.ask(STORE_SCRIPT, extension=text)

    def run_script(self, script: int, parameters: Sequence[int]) -> None:
        """Run a script from the top."""
        self.ask(RUN_SCRIPT, script, 0, _packed(parameters))

    def delete_script(self, script: int) -> None:
        """Stop and forget a script; one that is in a delay ends that first."""
        self.ask(DELETE_SCRIPT, script)

    def script_status(self, script: int) -> tuple[int, tuple[int, ...]]:
        """A script's status and its parameters; a negative one and none where there is no such."""
        return self.script_statuses([script])[0]

    def script_statuses(self, scripts: Sequence[int]) -> list[tuple[int, tuple[int, ...]]]:
        """The same of several, asked together."""
        answers = self.exchange([request(SCRIPT_STATUS, script) for script in scripts])
        statuses = []
        for answer in answers:
            status, *parameters = _STATUS.unpack(answer.following or _STATUS.pack(*[0] * 11))
            known = answer.result >= 0
            statuses.append((status, tuple(parameters)) if known else (answer.result, ()))
        return statuses

    def interrupt(self) -> None:
        """Make the command that another thread waits for fail."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection at once; may be called twice."""
        self.interrupt()
        self._socket.close()

    def _send(self, data: bytes) -> None:
        remaining = self._deadline - time.monotonic()
        if remaining <= 0.0:
            # Held up for so long, what comes now may rest upon what is over: it is not sent.
            raise TimeoutError
        self._socket.settimeout(remaining)
        try:
            self._socket.sendall(data)
        except TimeoutError:
            raise ConnectionError("it takes no more commands") from None

    def _receive(self, number: int) -> Answer:
        self._fill(_ANSWER.size)
        echo, _, _, result = _ANSWER.unpack_from(self._received)
        if echo != number:
            raise ConnectionError(f"it answers command {echo} instead of {number}")
        length = result if number == SCRIPT_STATUS and result > 0 else 0
        self._fill(_ANSWER.size + length)
        following = bytes(self._received[_ANSWER.size : _ANSWER.size + length])
        del self._received[: _ANSWER.size + length]
        return Answer(result, following)

    def _fill(self, size: int) -> None:
        """Wait until so many bytes have come; what is there already is taken at any time."""
        while len(self._received) < size:
            self._socket.settimeout(max(0.0, self._deadline - time.monotonic()))
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                raise TimeoutError from None
            if not data:
                within = 0 < len(self._received) < _ANSWER.size
                raise ConnectionResetError(
                    "it broke off in mid-answer" if within else "it closed the connection"
                )
            self._received += data


def where(place: Place) -> str:
    """How messages name this pigpiod."""
    return f"pigpiod at {place.host}:{place.port}"


def reason(error: BaseException, limit: float) -> str:
    """What went wrong, in a few words; `limit` is the time that pigpiod had [s]."""
    if isinstance(error, TimeoutError):
        return f"no answer within {limit * 1e3:g} ms"
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


@contextlib.contextmanager
def opened(place: Place, limit: float = ANSWER) -> Iterator[Client]:
    """A client for a few commands, each `within` or all within `limit` [s].

    Raises `ServoError` with one line for whatever fails inside.
    """
    client = None
    try:
        client = Client(place.host, place.port, limit)
        yield client
    except FAILURES as error:
        raise ServoError(f"{where(place)}: {reason(error, limit)}") from None
    finally:
        if client:
            client.close()


def _packed(parameters: Sequence[int]) -> bytes:
    return struct.pack(f"<{len(parameters)}i", *parameters)
