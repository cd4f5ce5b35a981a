"""Renewal of a lease of the fish in a thread, for `Fish`, `AsyncFish` and fishctl."""

import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol, Self

from fishd.core import text
from fishd.core.errors import FishError, LeaseLost
from fishd.core.protocol import Grant, State

log = logging.getLogger(__name__)

RENEWALS_PER_LEASE = 5
"""Number of renewals during the duration of a lease."""
MIN_BUSY_FRACTION = 0.02
"""Fraction of the time of a processor above which a thread counts as computing."""


class LeaseConnection(Protocol):
    """The part of `Fish` that the renewal of a lease needs."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def renew_lease(self, lease: str) -> State:
        """Restart the full duration of a lease."""

    def end_lease(self, lease: str) -> State:
        """Return the fish."""


class LeaseRenewal(threading.Thread):
    """Thread that renews a lease on a second connection until it is stopped or the lease is lost.

    A process that is killed, stopped by a signal or cut off from fishd does not renew. One that
    computes does. While the fish swims, the thread that took the lease counts as hung if it neither
    computes nor uses the fish for `idle_limit` seconds.
    """

    def __init__(
        self, connect: Callable[..., LeaseConnection], grant: Grant, idle_limit: float | None
    ) -> None:
        """connect: opens a connection with a timeout [s]; idle_limit: None for no limit [s]"""
        super().__init__(name="lease", daemon=True)
        self.token = grant.lease
        self.lost: LeaseLost | None = None
        """Error with the reason why the lease ended before the program returned it."""
        self.when_lost: Callable[[], object] = lambda: None
        """Function called in this thread once `lost` is set."""
        self.returned = False
        """Whether the lease was returned before the end of its `with` block."""
        self.used = time.monotonic()
        """Time at which the program last used the fish [s, monotonic]."""
        self._connect = connect
        self._every = grant.seconds / RENEWALS_PER_LEASE
        self._idle_limit = idle_limit
        self._stopping = threading.Event()
        self._owner = time.pthread_getcpuclockid(threading.get_ident())
        self._computed = self._looked = 0.0
        self.start()

    def run(self) -> None:
        """Renew until stopped."""
        with self._connect(timeout=self._every) as fish:
            while self.lost is None and not self._stopping.wait(self._every):
                try:
                    self._judge(fish, fish.renew_lease(self.token))
                except LeaseLost as error:
                    self.lost = error
                except FishError:  # no answer in time, or no fishd: the next renewal may succeed
                    continue
        if self.lost and not self._stopping.is_set():
            self.when_lost()

    def stop(self) -> None:
        """Stop the renewals, and wait for one in progress; may be called twice."""
        self._stopping.set()
        self.join()

    def _judge(self, fish: LeaseConnection, state: State) -> None:
        """Return the fish if it swims while the program is idle."""
        now, computed = time.monotonic(), self._cpu_seconds()
        busy = computed - self._computed > MIN_BUSY_FRACTION * (now - self._looked)
        self._computed, self._looked = computed, now
        if busy or state.mode != "running":
            self.used = now
        if self._idle_limit is not None and now - self.used > self._idle_limit:
            fish.end_lease(self.token)
            raise LeaseLost(
                "no-lease",
                f"this program did nothing with the fish for {self._idle_limit:g} s while it swam, "
                "and returned it; read ticks while it swims, or set idle_limit",
            )

    def _cpu_seconds(self) -> float:
        try:
            return time.clock_gettime(self._owner)
        except OSError:  # the thread has ended
            return self._computed


def lease_arguments(name: str, take: bool, seconds: float | None) -> dict[str, Any]:
    """Return the arguments of take-lease for this process."""
    host = text.line(socket.gethostname(), 64)
    return {
        "name": text.line(name, 60),
        "host": host,
        "pid": os.getpid(),
        "seconds": seconds,
        "take": take,
    }


def report_unreturned(error: FishError, exception: BaseException | None) -> None:
    """Log that the fish could not be returned, unless `exception` is about that already."""
    if not isinstance(exception, FishError):
        log.warning(
            "the fish could not be returned, and rests once its lease has expired: %s", error
        )
