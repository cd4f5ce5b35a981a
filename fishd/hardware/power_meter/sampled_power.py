"""The power of the servo, whatever the driver: a thread reads the meter, the tick takes the mean.

In virtual time there is no thread: `catch_up` reads it when it is due.
"""

import math
import threading
from typing import Any

from fishd.core.clock import Clock
from fishd.core.errors import SensorError
from fishd.hardware.driver import PowerMeterDriver, PowerSample, survived
from fishd.hardware.sampler import Sampler

PER_TICK = 4
"""Samples in a tick, as far apart as possible from the tick itself."""
SHORTEST = 5e-3
"""Between two samples, at the least: so slow does a fast tick leave the bus to the forces [s]."""
CLOSE_LIMIT = 0.5
"""How long to wait for the thread to end [s]."""
_POLL = 0.05  # while nobody reads, s


def interval_of(tick: float) -> float:
    """Time from one sample to the next, for ticks of so long [s]."""
    return max(SHORTEST, tick / PER_TICK)


class SampledPower:
    """A power meter that samples by itself; `read` and `close` are for the thread that ticks."""

    def __init__(
        self,
        driver: PowerMeterDriver[Any],
        clock: Clock,
        *,
        threaded: bool,
        tick: float,
    ) -> None:
        """Begin to sample; a meter that is missing may come later. As of `SampledSensor`."""
        self._clock = clock
        self._place = driver.place
        self._transport = driver.transport
        self._driver = driver
        self._interval = driver.interval
        self._stale = 2.0 * max(tick, driver.interval)
        self._sampler: Sampler[PowerSample] = Sampler(driver, clock)
        self._latest = PowerSample(-math.inf, math.nan)
        self._origin = clock.monotonic()
        """When the latest tick was, from which samples are counted."""
        self._due = self._origin + 0.5 * self._interval
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name="power-sampler", daemon=True)
            self._thread.start()

    def read(self, now: float) -> float:
        """Mean power of the samples since the previous read [W]; waits for nothing.

        Without a new one it is that of the latest, as long as that is fresh. Raises `SensorError`,
        with what to check, while the meter cannot be read, and once closed.
        """
        if self._closing.is_set():
            raise SensorError(f"{self._place} is closed")
        if self._thread is None:
            self.catch_up()
        self._origin = now
        came = self._sampler.samples
        samples = [came.popleft() for _ in range(len(came))]
        if samples:
            self._latest = samples[-1]
        elif trouble := self._sampler.trouble:
            raise SensorError(trouble)
        elif now - self._latest.time > self._stale:
            raise SensorError(f"{self._place} has not delivered for {self._stale * 1e3:.0f} ms")
        else:
            samples = [self._latest]
        if clipped := next((each.clipped for each in samples if each.clipped), ""):
            raise SensorError(clipped)
        return sum(each.power for each in samples) / len(samples)

    def catch_up(self) -> None:
        """In virtual time: sample where that is due."""
        now = self._clock.monotonic()
        if now >= max(self._due, self._sampler.ready_at):
            self._sampler.step()
            self._due = self._next(now)

    def counters(self) -> dict[str, int]:
        """Errors that were survived, since start."""
        sampler, transport = self._sampler, self._transport
        return {
            f"{transport}_errors": sampler.errors,
            f"{transport}_reconnects": sampler.reconnects,
            **survived(self._driver),
        }

    def close(self) -> None:
        """Stop to sample and let go of the meter; may be called twice, and never hangs."""
        self._closing.set()
        if self._thread is None:
            self._sampler.close()
        else:
            self._thread.join(CLOSE_LIMIT)

    def _next(self, now: float) -> float:
        """When the next sample is due: halfway between those instants at which ticks begin."""
        passed = math.floor((now - self._origin) / self._interval + 0.5)
        return self._origin + (passed + 0.5) * self._interval

    def _run(self) -> None:
        """Sample until closed; what the thread does."""
        clock, sampler = self._clock, self._sampler
        while not self._closing.is_set():
            pause = max(sampler.ready_at, self._due) - clock.monotonic()
            if pause > 0.0:
                self._closing.wait(min(pause, _POLL))
                continue
            sampler.step()
            self._due = self._next(clock.monotonic())
        sampler.close()
