"""Power meter of every driver: a thread reads it, and each tick takes the mean.

In virtual time `catch_up` reads the meter when it is due, instead of a thread.
"""

import math
from typing import Any

from fishd.core.clock import Clock
from fishd.core.errors import SensorError
from fishd.hardware.driver import PowerMeterDriver, PowerSample
from fishd.hardware.sampler import SampledPart

SAMPLES_PER_TICK = 4
"""Number of samples in a tick, as far as possible from the tick itself."""
MIN_INTERVAL_S = 5e-3
"""Shortest time between two samples, which leaves the bus to the forces in short ticks [s]."""
_MAX_WAIT_S = 0.05
"""Longest wait of the thread before it looks again whether a sample is due [s]."""


def sample_interval(tick: float) -> float:
    """Return the time between two samples for a tick [s]."""
    return max(MIN_INTERVAL_S, tick / SAMPLES_PER_TICK)


class SampledPower(SampledPart[PowerSample]):
    """Power meter that samples by itself; `read` and `close` are for the thread that ticks."""

    def __init__(
        self, driver: PowerMeterDriver[Any], clock: Clock, *, threaded: bool, tick: float
    ) -> None:
        """Start to sample; a meter that is missing may appear later.

        The arguments are those of `SampledSensor`.
        """
        super().__init__(driver, clock)
        self._interval = driver.interval
        self._stale = 2.0 * max(tick, driver.interval)
        self._latest = PowerSample(-math.inf, math.nan)
        self._origin = clock.monotonic()
        """Time of the latest tick, from which the times of samples are counted [s, monotonic]."""
        self._due = self._origin + 0.5 * self._interval
        if threaded:
            self._start_thread("power-sampler")

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
        if self._clock.monotonic() >= max(self._due, self._sampler.ready_at):
            self._step()

    def _pause(self) -> float:
        due = max(self._due, self._sampler.ready_at)
        return min(due - self._clock.monotonic(), _MAX_WAIT_S)

    def _step(self) -> None:
        """Make one attempt; the next is due half an interval away from each possible tick."""
        self._sampler.step()
        passed = math.floor((self._clock.monotonic() - self._origin) / self._interval + 0.5)
        self._due = self._origin + (passed + 0.5) * self._interval
