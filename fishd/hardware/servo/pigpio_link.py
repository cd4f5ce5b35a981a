"""The link to pigpiod: one client at a time, thrown away after any failure and made again."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from fishd.core.clock import Clock
from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio_client import ANSWER, FAILURES, Client, reason, where

if TYPE_CHECKING:
    from fishd.hardware.servo.pigpio import PigpioSettings

START = 2.0
"""How long a new link waits for its first connection [s]."""

PAUSES = 0.2, 1.0
"""Shortest and longest pause between two attempts to connect [s]."""

LATE_STREAK = 3
"""Ticks in a row without an answer that end a connection."""

VIRTUAL_PAUSE = 0.5
"""Virtual time between two attempts to connect [s]."""

VIRTUAL_PATIENCE = 20.0
"""In virtual time, how long everything may take on this machine [s].

No tick waits there, and a busy machine must not pass for a frozen pigpiod: whether that answers
in time is asked of pigpiod itself.
"""


class PigpioLink:
    """One client at a time, kept connected."""

    def __init__(
        self,
        settings: "PigpioSettings",
        clock: Clock,
        prepare: Callable[[Client], None],
        *,
        threaded: bool,
        standstill: Callable[[], bool] | None = None,
    ) -> None:
        """Wait up to 2 s for the first connection; without one, go on trying.

        prepare: called with every new client before anyone else has it; if it raises, the client
            is thrown away
        threaded: connect in a thread of its own. Otherwise within `session`, at most once per
            0.5 s of `clock`
        standstill: in virtual time, whether pigpiod answers nothing before time moves on: then
            nobody waits, and no answer is late because the machine is busy
        """
        self.reconnects = 0
        """How often a connection was made again."""
        self.late_answers = 0
        """How many sessions ended without an answer in time."""
        self._settings = settings
        self._where = where(settings.host, settings.port)
        self._clock = clock
        self._prepare = prepare
        self._standstill = standstill
        self._client: Client | None = None
        self._opening: Client | None = None
        self._reason = "no answer yet"
        self._connections = 0
        self._late = 0  # sessions in a row
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
            self._connected.wait(START)

    @contextlib.contextmanager
    def session(
        self, *, forgives: Callable[[], bool] | None = None, last: bool = False
    ) -> Iterator[Client]:
        """The client, all of whose commands must be done within the time limit of the settings.

        forgives: asked when an answer is late, whether that is no error: it is then waited for in
            the next session, and what was to come after that command is left out
        last: nobody will reconnect after it, and no tick waits: it may take 1 s
        Raises `ServoError` where there is no connection, without waiting for one, and where a
        command fails. That ends the connection, unless an answer is merely late, up to twice in a
        row.
        """
        limit = ANSWER if last else self._settings.timeout
        outlook = "" if last else "; reconnecting"
        patience = self._patience(limit)
        deadline = time.monotonic() + patience
        if not self._lock.acquire(timeout=patience):
            raise ServoError(f"{self._where}: busy for more than {limit * 1e3:g} ms")
        try:
            client = self._current(outlook)
            client.within(deadline - time.monotonic())
            try:
                yield client
                self._late = 0
            except TimeoutError as error:
                self._late += 1
                self.late_answers += 1
                why = reason(error, limit)
                if self._late >= LATE_STREAK or last or not (forgives is None or forgives()):
                    self._drop(client, why)
                elif forgives:
                    return
                else:
                    outlook = "; waiting for it"
                raise ServoError(f"{self._where}: {why}{outlook}") from None
            except BaseException as error:
                self._drop(client, reason(error, limit))
                if not isinstance(error, FAILURES):
                    raise
                raise ServoError(f"{self._where}: {self._reason}{outlook}") from None
        finally:
            self._lock.release()

    def close(self) -> None:
        """Disconnect, and connect no more; may be called twice."""
        self._closed.set()
        self._needed.set()
        with self._lock:
            if self._client:
                self._drop(self._client, "closed")
        opening = self._opening
        if opening:
            opening.interrupt()
        if self._thread:
            self._thread.join(ANSWER)

    def _patience(self, limit: float) -> float:
        """How long to wait by the clock of this machine for what has a limit [s]."""
        return VIRTUAL_PATIENCE if self._standstill else limit

    def _current(self, outlook: str) -> Client:
        if self._closed.is_set():
            raise ServoError(f"{self._where}: closed")
        now = self._clock.monotonic()
        if not self._client and not self._thread and now >= self._next_attempt:
            self._next_attempt = now + VIRTUAL_PAUSE
            self._connect(ANSWER, 2.0 * ANSWER)
        if not self._client:
            raise ServoError(f"{self._where}: not connected: {self._reason}{outlook}")
        return self._client

    def _drop(self, client: Client, why: str) -> None:
        self._client = None
        self._reason = why
        client.close()
        self._needed.set()

    def _connect(self, limit: float, preparation: float) -> bool:
        client = None
        allowed = limit
        try:
            client = self._opening = Client(
                self._settings.host, self._settings.port, self._patience(limit), self._standstill
            )
            if self._closed.is_set():  # by one who may not have seen it
                raise ConnectionError("closed")
            client.get_pigpio_version()
            allowed = preparation
            client.within(self._patience(preparation))
            self._prepare(client)
        except BaseException as error:
            self._reason = reason(error, allowed)
            if client:
                client.close()
            if isinstance(error, Exception):  # whatever it is, the next attempt may do better
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
        shortest, longest = PAUSES
        while self._needed.wait() and not self._closed.is_set():
            self._needed.clear()
            pause = shortest
            while not self._connect(ANSWER, 2.0 * ANSWER) and not self._closed.wait(pause):
                pause = min(2.0 * pause, longest)
            # A pigpiod that refuses every command would otherwise be connected to in every tick.
            self._closed.wait(shortest)
