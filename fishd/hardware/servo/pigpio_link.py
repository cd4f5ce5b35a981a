"""Link to pigpiod: one client at a time, replaced by a new one after any failure."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from fishd.core.clock import Clock
from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio_client import (
    ANSWER_TIMEOUT_S,
    COMMAND_ERRORS,
    Client,
    MissingCommands,
    describe_error,
    pigpiod_at,
)

START_TIMEOUT_S = 2.0
"""Longest time that a new link waits for its first connection [s]."""

PREPARATION_TIMEOUT_S = 2.0
"""Longest time for the preparation of a new connection [s]."""

PAUSE_RANGE_S = 0.2, 1.0
"""Shortest and longest pause between two attempts to connect [s]."""

MAX_LATE_ANSWERS = 3
"""Number of ticks in a row without an answer that ends a connection."""

VIRTUAL_PAUSE_S = 0.5
"""Virtual time between two attempts to connect [s]."""

VIRTUAL_TIMEOUT_S = 20.0
"""Real-time limit of every step in virtual time [s].

In virtual time no tick waits, and a busy machine must not look like a frozen pigpiod: the virtual
pigpiod itself says whether it answers in time.
"""


class PigpioLink:
    """Link that keeps one client connected."""

    def __init__(
        self,
        address: tuple[str, int],
        timeout: float,
        clock: Clock,
        prepare: Callable[[Client], None],
        *,
        threaded: bool,
        standstill: Callable[[], bool] | None = None,
    ) -> None:
        """Wait up to 2 s for the first connection; without one, keep trying.

        address: host and port of pigpiod
        timeout: longest time that a session waits for pigpiod [s]
        prepare: function called with every new client before its use; if it raises, the client is
            closed
        threaded: connect in a separate thread; otherwise in `session`, at most once per 0.5 s of
            `clock`
        standstill: function that returns, in virtual time, whether pigpiod answers nothing before
            time advances; then no command waits, and no answer is late because the machine is busy
        """
        self.reconnects = 0
        """Number of connections after the first."""
        self.late_answers = 0
        """Number of sessions that ended without an answer in time."""
        self._address = address
        self._timeout = timeout
        self._where = pigpiod_at(*address)
        self._clock = clock
        self._prepare = prepare
        self._standstill = standstill
        self._client: Client | None = None
        self._opening: Client | None = None
        self._trouble = f"{self._where}: not connected: no answer yet"
        self._connections = 0
        self._late = 0  # number of late sessions in a row
        self._next_attempt = float("-inf")
        self._lock = threading.RLock()
        self._needed = threading.Event()
        self._connected = threading.Event()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._needed.set()
            self._thread = threading.Thread(
                target=self._keep_connected, name="pigpio-link", daemon=True
            )
            self._thread.start()
            self._connected.wait(START_TIMEOUT_S)

    @contextlib.contextmanager
    def session(
        self, *, may_be_late: Callable[[], bool] | None = None, last: bool = False
    ) -> Iterator[Client]:
        """Return the client; all commands in the context share the timeout of this link.

        may_be_late: function called when an answer is late; if it returns True, the next session
            waits for the answer, and the rest of this session is skipped without an error
        last: True for the last session, which no tick waits for: it may take 1 s
        Raises `ServoError` at once if not connected, and if a command fails. A failure ends the
        connection, except for late answers, up to two in a row.
        """
        limit = ANSWER_TIMEOUT_S if last else self._timeout
        suffix = "" if last else "; reconnecting"
        real_limit = self._real_limit(limit)
        deadline = time.monotonic() + real_limit
        if not self._lock.acquire(timeout=real_limit):
            raise ServoError(f"{self._where}: busy for more than {limit * 1e3:g} ms")
        try:
            client = self._current(suffix)
            client.within(deadline - time.monotonic())
            try:
                yield client
                self._late = 0
            except TimeoutError as error:
                self._late += 1
                self.late_answers += 1
                why = describe_error(error, limit)
                if (
                    self._late >= MAX_LATE_ANSWERS
                    or last
                    or not (may_be_late is None or may_be_late())
                ):
                    self._drop(client, why)
                elif may_be_late:
                    return
                else:
                    suffix = "; waiting for it"
                raise ServoError(f"{self._where}: {why}{suffix}") from None
            except BaseException as error:
                why = describe_error(error, limit)
                self._drop(client, why)
                if not isinstance(error, COMMAND_ERRORS):
                    raise
                raise ServoError(f"{self._where}: {why}{suffix}") from None
        finally:
            self._lock.release()

    def close(self) -> None:
        """Disconnect, and do not connect again; may be called twice."""
        self._closed.set()
        self._needed.set()
        with self._lock:
            if self._client:
                self._drop(self._client, "closed")
        opening = self._opening
        if opening:
            opening.interrupt()
        if self._thread:
            self._thread.join(ANSWER_TIMEOUT_S)

    def _real_limit(self, limit: float) -> float:
        """Return the wait in real time for a step with a time limit [s]."""
        return VIRTUAL_TIMEOUT_S if self._standstill else limit

    def _current(self, suffix: str) -> Client:
        if self._closed.is_set():
            raise ServoError(f"{self._where}: closed")
        now = self._clock.monotonic()
        if not self._client and not self._thread and now >= self._next_attempt:
            self._next_attempt = now + VIRTUAL_PAUSE_S
            self._connect()
        if not self._client:
            raise ServoError(f"{self._trouble}{suffix}")
        return self._client

    def _drop(self, client: Client, why: str) -> None:
        self._client = None
        self._trouble = f"{self._where}: not connected: {why}"
        client.close()
        self._needed.set()

    def _connect(self) -> bool:
        client, limit = None, ANSWER_TIMEOUT_S
        real_limit = self._real_limit(limit)
        try:
            client = self._opening = Client(*self._address, real_limit, self._standstill)
            if self._closed.is_set():  # `close` may have run before `_opening` was set
                raise ConnectionError("closed")
            client.identify()
            limit = PREPARATION_TIMEOUT_S
            client.within(self._real_limit(limit))
            self._prepare(client)
        except BaseException as error:
            why = describe_error(error, limit)
            is_named = isinstance(error, MissingCommands)
            self._trouble = why if is_named else f"{self._where}: not connected: {why}"
            if client:
                client.close()
            if isinstance(error, Exception):  # the next attempt may succeed
                return False
            raise
        finally:
            self._opening = None
        with self._lock:
            if self._closed.is_set():
                client.close()
                return False
            self._connections += 1
            self._late = 0
            self.reconnects = self._connections - 1
            self._client = client
        self._connected.set()
        return True

    def _keep_connected(self) -> None:
        shortest, longest = PAUSE_RANGE_S
        while self._needed.wait() and not self._closed.is_set():
            self._needed.clear()
            pause = shortest
            while not self._connect() and not self._closed.wait(pause):
                pause = min(2.0 * pause, longest)
            # Without this pause, fishd would connect in every tick to a pigpiod that refuses all.
            self._closed.wait(shortest)
