"""Sampler of a driver, which it opens again after failures, and the parts that have one."""

import math
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, Generic, TypeVar

from fishd.core import text
from fishd.core.clock import Clock
from fishd.core.foreign_code import call_foreign
from fishd.hardware.driver import Pair, SampledDriver, read_counters

X = TypeVar("X", Pair, Mapping[str, float])

MAX_SAMPLES = 4096
"""Largest number of samples kept until they are read; the oldest are dropped."""
REOPEN_FAILURES = 3
"""Number of failures in a row after which the hardware is opened again."""
MAX_PAUSE_S = 0.5
"""Longest time between two attempts [s]."""
_MIN_PAUSE_S = 1e-3
CLOSE_TIMEOUT_S = 0.5
"""Longest wait for the end of a thread that samples [s]."""


class Sampler(Generic[X]):
    """Owner of a driver; only one thread may use it, except for the parts marked below."""

    def __init__(self, driver: SampledDriver[Any], clock: Clock) -> None:
        """Open nothing yet."""
        self._driver = driver
        self._clock = clock
        self.samples: deque[X] = deque(maxlen=MAX_SAMPLES)
        """Samples received, for another thread to take with `popleft`."""
        self.trouble: str | None = None
        """Reason why the latest attempt failed, one line; None if it did not. For any thread."""
        self.errors = 0
        """Number of failed attempts since start. For any thread."""
        self.reconnects = 0
        """Number of times that samples came again after a new opening. For any thread."""
        self.ready_at = -math.inf
        """Earliest time of the next attempt [s, monotonic]."""
        self._failures = 0
        self._open = False

    def step(self) -> None:
        """Make one attempt to sample, and wait on the clock until it is due; never raises."""
        wait = self.ready_at - self._clock.monotonic()
        if wait > 0.0:
            self._clock.sleep(wait)
        try:
            if not self._open:
                call_foreign(self._driver.open)
                self._open = True
            sample = call_foreign(self._driver.sample)
        except Exception as error:  # the libraries of drivers raise all kinds of exceptions
            self._recover(error)
        else:
            if sample is not None:
                self.samples.append(sample)
                self.reconnects += self._failures >= REOPEN_FAILURES
                self._failures = 0
                self.trouble = None

    def close(self) -> None:
        """Release the hardware; never raises, may be called twice."""
        self._open = False
        with suppress(Exception):
            call_foreign(self._driver.close)

    def _recover(self, error: Exception) -> None:
        """Give the hardware time to settle, and more after several failures."""
        self.trouble = self._explain(error)
        self.errors += 1
        self._failures += 1
        pause = max(self._driver.settling, _MIN_PAUSE_S)
        if self._failures >= REOPEN_FAILURES:
            self.close()
            pause = min(MAX_PAUSE_S, pause * 2.0 ** min(self._failures - REOPEN_FAILURES, 10))
        self.ready_at = self._clock.monotonic() + pause

    def _explain(self, error: Exception) -> str:
        try:
            return call_foreign(self._driver.explain, error)
        except Exception:  # a failure of `explain` must not hide the error itself
            return text.describe_error(error)


class SampledPart(ABC, Generic[X]):
    """Part of the robot whose driver is sampled: in a thread, or in virtual time on request."""

    def __init__(self, driver: SampledDriver[Any], clock: Clock, counter: str) -> None:
        """Start nothing yet.

        counter: prefix of the counters of errors: `i2c` makes `i2c_errors`
        """
        self._clock = clock
        self._counter = counter
        self._driver = driver
        self._place = driver.place
        self._sampler: Sampler[X] = Sampler(driver, clock)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def counters(self) -> dict[str, int]:
        """Return the numbers of recovered errors since start."""
        return {
            f"{self._counter}_errors": self._sampler.errors,
            f"{self._counter}_reconnects": self._sampler.reconnects,
            **read_counters(self._driver),
        }

    @property
    def limitations(self) -> tuple[str, ...]:
        """Reasons why the samples are not as good as they could be, a line each."""
        return self._driver.limitations

    def close(self, timeout: float = CLOSE_TIMEOUT_S) -> None:
        """Stop sampling and release the hardware; may be called twice, and never hangs.

        timeout: longest wait for its thread [s]; one that hangs in a transfer ends by itself
        """
        self._closing.set()
        if self._thread is None:
            self._sampler.close()
        else:
            self._thread.join(timeout)

    def _start_thread(self, name: str) -> None:
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Sample until closed, in the thread."""
        while not self._closing.is_set():
            pause = self._pause()
            if pause > 0.0:
                self._closing.wait(pause)
            else:
                self._step()
        self._sampler.close()

    @abstractmethod
    def _pause(self) -> float:
        """Return how long to wait before looking again whether a sample is due [s]; 0 if it is."""

    @abstractmethod
    def _step(self) -> None:
        """Make one attempt to sample."""


def close_all(parts: Iterable[SampledPart[Any]]) -> None:
    """Close parts; wait no longer for many of them that hang than for one."""
    parts, deadline = list(parts), time.monotonic() + CLOSE_TIMEOUT_S
    for part in parts:
        part.close(0.0)
    for part in parts:
        part.close(max(0.0, deadline - time.monotonic()))
