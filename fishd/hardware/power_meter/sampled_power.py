"""Power meter of every driver: a thread reads it, and each tick takes the mean.

In virtual time `catch_up` reads the meter when it is due, instead of a thread.
"""

import math
import threading
from typing import Any

from fishd.core.clock import Clock
from fishd.core.errors import SensorError
from fishd.hardware.driver import PowerMeterDriver, PowerSample, read_counters
from fishd.hardware.sampler import Sampler

SAMPLES_PER_TICK = 4
"""Number of samples in a tick, as far as possible from the tick itself."""
MIN_INTERVAL_S = 5e-3
"""Shortest time between two samples, which leaves the bus to the forces in short ticks [s]."""
CLOSE_TIMEOUT_S = 0.5
"""Longest wait for the thread to end [s]."""
_MAX_WAIT_S = 0.05
"""Longest wait of the thread before it looks again whether a sample is due [s]."""


def sample_interval(tick: float) -> float:
    """Return the time between two samples for a tick [s]."""
    return max(MIN_INTERVAL_S, tick / SAMPLES_PER_TICK)


class SampledPower:
    """Power meter that samples by itself; `read` and `close` are for the thread that ticks."""

    def __init__(
        self,
        driver: PowerMeterDriver[Any],
        clock: Clock,
        *,
        threaded: bool,
        tick: float,
    ) -> None:
        """Start to sample; a meter that is missing may appear later.

        The arguments are those of `SampledSensor`.
        """
        self._clock = clock
        self._place = driver.place
        self._transport = driver.transport
        self._driver = driver
        self._interval = driver.interval
        self._stale = 2.0 * max(tick, driver.interval)
        self._sampler: Sampler[PowerSample] = Sampler(driver, clock)
        self._latest = PowerSample(-math.inf, math.nan)
        self._origin = clock.monotonic()
        """Time of the latest tick, from which the times of samples are counted [s, monotonic]."""
        self._due = self._origin + 0.5 * self._interval
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name="power-sampler", daemon=True)
            self._thread.start()

    def read(self, now: float) -> float:
        """Return the mean power of the samples since the previous read [W]; never waits.

        Without a new sample it is the power of the latest, while that is fresh. Raises
        `SensorError`, with what to check, while the meter cannot be read, and after `close`.
        """
        if self._closing.is_set():
            raise SensorError(f"{self._place} is closed")
        if self._thread is None:
            self.catch_up()
        self._origin = now
        new_samples = self._sampler.samples
        samples = [new_samples.popleft() for _ in range(len(new_samples))]
        if samples:
            self._latest = samples[-1]
        elif trouble := self._sampler.trouble:
            raise SensorError(trouble)
        elif now - self._latest.time > self._stale:
            raise SensorError(
                f"{self._place} has not delivered a sample for {self._stale * 1e3:.0f} ms"
            )
        else:
            samples = [self._latest]
        if clipped := next((sample.clipped for sample in samples if sample.clipped), ""):
            raise SensorError(clipped)
        return sum(sample.power for sample in samples) / len(samples)

    def catch_up(self) -> None:
        """Take a sample if one is due; for virtual time."""
        now = self._clock.monotonic()
        if now >= max(self._due, self._sampler.ready_at):
            self._sampler.step()
            self._due = self._next(now)

    def counters(self) -> dict[str, int]:
        """Return the numbers of recovered errors since start."""
        sampler, transport = self._sampler, self._transport
        return {
            f"{transport}_errors": sampler.errors,
            f"{transport}_reconnects": sampler.reconnects,
            **read_counters(self._driver),
        }

    def close(self) -> None:
        """Stop sampling and release the meter; may be called twice, and never hangs."""
        self._closing.set()
        if self._thread is None:
            self._sampler.close()
        else:
            self._thread.join(CLOSE_TIMEOUT_S)

    def _next(self, now: float) -> float:
        """Return when the next sample is due: half an interval away from each possible tick."""
        passed = math.floor((now - self._origin) / self._interval + 0.5)
        return self._origin + (passed + 0.5) * self._interval

    def _run(self) -> None:
        """Sample until closed, in the thread."""
        clock, sampler = self._clock, self._sampler
        while not self._closing.is_set():
            pause = max(sampler.ready_at, self._due) - clock.monotonic()
            if pause > 0.0:
                self._closing.wait(min(pause, _MAX_WAIT_S))
                continue
            sampler.step()
            self._due = self._next(clock.monotonic())
        sampler.close()
