"""Sensor of every driver: a thread samples it, and each tick takes the latest values.

In virtual time `read` samples when it is due, instead of a thread.
"""

import math
from collections.abc import Mapping
from typing import Any

from fishd.core import text
from fishd.core.clock import Clock
from fishd.core.foreign_code import real_number
from fishd.core.schema import Reading, format_quantity, format_reading
from fishd.hardware.driver import SensorDriver, SensorSettings
from fishd.hardware.sampler import SampledPart

MIN_PERIOD_S = 5e-3
"""Shortest default of the time between two samples, which leaves a bus to the forces [s]."""
MIN_STALE_PERIODS, MIN_STALE_TICKS = 3.0, 2.0
"""Ages from which a reading is old, of which the longer one counts."""
_MAX_WAIT_S = 0.05
"""Longest wait of the thread before it looks again whether a sample is due [s]."""


def sample_period(kind: type[SensorDriver[Any]], settings: SensorSettings, tick: float) -> float:
    """Return the time between two samples for a tick [s]."""
    return settings.period or max(MIN_PERIOD_S, tick / kind.samples_per_tick)


class SampledReadings(SampledPart[Mapping[str, float]]):
    """Sensor that samples by itself; its properties and `close` are for the thread that ticks."""

    def __init__(
        self,
        name: str,
        driver: SensorDriver[Any],
        declared: Mapping[str, Reading],
        clock: Clock,
        *,
        threaded: bool,
        tick: float,
    ) -> None:
        """Start to sample; a sensor that is missing may appear later.

        name: name in the configuration
        declared: its readings, with the names that the configuration gives them
        threaded: sample in a thread, which needs a clock that advances by itself
        tick: period of the loop, over which faster samples are averaged [s]
        """
        super().__init__(driver, clock, name)
        settings = driver.settings
        self.name = name
        self._names = settings.rename
        self.declared = declared
        self.required = settings.required
        self.stale_after = settings.stale_after or max(
            MIN_STALE_TICKS * tick, MIN_STALE_PERIODS * driver.period
        )
        self._latest: dict[str, tuple[float, float]] = {}
        self.doubts: dict[str, str] = {}
        self._samples: dict[str, list[tuple[float, float]]] = {}
        self._misfit: str | None = None
        """Reason why the latest sample does not fit the declared readings; None if it does."""
        self._period, self._tick = driver.period, tick
        # In virtual time, that is as far as possible from the ticks.
        self._due = clock.monotonic() + 0.5 * min(driver.period, tick)
        if threaded:
            self._start_thread(f"sensor-{name}")

    @property
    def trouble(self) -> str | None:
        """Reason why the latest attempt to sample failed, one line; None if it did not."""
        return self._misfit or self._sampler.trouble

    def read(self) -> dict[str, tuple[float, float]]:
        """Return time [s, monotonic] and value of each reading that is known; never waits.

        The mapping never changes. In virtual time, a sample is taken first, if one is due.
        """
        if self._thread is None and self._pause() <= 0.0:
            self._step()
        return self._latest

    def _pause(self) -> float:
        due = max(self._due, self._sampler.ready_at)
        return min(due - self._clock.monotonic(), _MAX_WAIT_S)

    def _step(self) -> None:
        self._sampler.step()
        now = self._clock.monotonic()
        while self._sampler.samples:
            try:
                self._take(self._sampler.samples.popleft(), now)
                self._misfit = None
            except Exception as error:  # a driver of another package returns anything
                self._misfit = text.describe_error(error)
        self._due = max(self._due + self._period, now)

    def _take(self, values: Mapping[str, float], now: float) -> None:
        """Keep the values of a sample, each as the mean over the latest tick."""
        latest, doubts = dict(self._latest), dict(self.doubts)
        for own_name, value in values.items():
            name = self._names.get(own_name, own_name)
            if name not in self.declared:
                raise ValueError(f"it gives {name}, but declares {', '.join(self.declared)}")
            number = real_number(value, name)
            if not math.isfinite(number):
                doubts[name] = f"{name} is not a number"
                continue
            before = self._samples.get(name, ())
            # A sample that is a tick old is no part of the mean; half a period is for rounding.
            since = now - self._tick + 0.5 * self._period
            recent = [sample for sample in before if sample[0] > since]
            self._samples[name] = recent = [*recent, (now, number)]
            latest[name] = now, math.fsum(value for _, value in recent) / len(recent)
            doubts.pop(name, None)
            if doubt := _describe_doubt(name, self.declared[name], number):
                doubts[name] = doubt
        self._latest, self.doubts = latest, doubts


def _describe_doubt(name: str, reading: Reading, value: float) -> str | None:
    """Return in words that a value is beyond the limits of its reading; None if it is not."""
    if reading.low is not None and value < reading.low:
        beyond = f"less than {format_quantity(reading.low, reading.unit)}"
    elif reading.high is not None and value > reading.high:
        beyond = f"more than {format_quantity(reading.high, reading.unit)}"
    else:
        return None
    return f"{name} is {format_reading(value, reading.unit)}, {beyond}"
