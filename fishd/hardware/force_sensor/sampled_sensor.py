"""Dual force sensor of every driver: a thread samples it, and each tick takes the new samples.

In virtual time a read samples instead of a thread, until its clock has reached the tick.
"""

import math
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from fishd.core.calibration import ForceCalibration
from fishd.core.clock import Clock
from fishd.core.errors import SensorError
from fishd.core.signals import Measurement
from fishd.hardware.driver import ForceSensorDriver, Pair
from fishd.hardware.force_sensor.window import VoltageWatch, WindowEvaluation
from fishd.hardware.sampler import SampledPart

QUIET_TIME_S = 2.2e-3
"""Time without conversions before and after a read, at most an eighth of a tick [s].

It is the time for which the ticker is awake before a deadline: two threads of one interpreter delay
each other.
"""


class SampledSensor(SampledPart[Pair]):
    """Force sensor that measures voltages and can be calibrated.

    Only the thread that ticks may read, watch and calibrate it.
    """

    def __init__(
        self,
        driver: ForceSensorDriver[Any],
        calibration: ForceCalibration,
        clock: Clock,
        *,
        threaded: bool,
        tick: float,
        between_samples: Callable[[], None] = lambda: None,
    ) -> None:
        """Start to sample; hardware that is missing may appear later.

        clock: clock of the driver; in virtual time a separate clock, which reads advance
        threaded: sample in a thread, which needs a clock that advances by itself
        tick: time between two reads [s]
        between_samples: function called before each sample in virtual time, for other users of the
            clock
        """
        super().__init__(driver, clock, driver.transport)
        self.calibration = calibration
        """Calibration that turns voltages into forces."""
        self._tick = tick
        self._quiet_time = min(QUIET_TIME_S, 0.125 * tick)
        self._step_time = 0.0
        self._between_samples = between_samples
        self._evaluation = WindowEvaluation(driver.settings, driver.names, driver.raw_unit)
        self._latest: Measurement | None = None
        self._watches: list[VoltageWatch] = []
        self._next_read = math.inf
        if threaded:
            self._start_thread("force-sampler")

    def recalibrate(self, calibration: ForceCalibration) -> None:
        """Use another calibration from the next read on."""
        self.calibration = calibration

    def read(self, now: float) -> Measurement:
        """Return the measurement since the previous read; never waits in real time.

        Without a new pair of samples this is the previous measurement with its time, marked as
        holding no samples and as not suspect. Raises `SensorError`, with what to check, while the
        hardware cannot be read, before the first pair, and after `close`.
        """
        if self._closing.is_set():
            raise SensorError(f"{self._place} is closed")
        if self._thread is None:
            self._catch_up(now)
        self._next_read = now + self._tick
        pairs = self._take(now)
        if pairs:
            measurement = self._evaluation.measure(pairs, self.calibration)
            if self._watches:
                self._watches = [watch for watch in self._watches if not watch.closed]
                for watch in self._watches:
                    watch.add(pairs, measurement.suspect)
            self._latest = replace(measurement, samples=0, suspect=None, extremes=None)
            return measurement
        if trouble := self._sampler.trouble:
            self._evaluation.interrupt()
            raise SensorError(trouble)
        if self._latest is None:
            raise SensorError(f"{self._place} has not delivered a sample yet")
        return self._latest

    @property
    def unit(self) -> str:
        """Unit of the forces: N, or that of the driver until the sensor is calibrated."""
        return self._evaluation.unit(self.calibration)

    def watch(self) -> VoltageWatch:
        """Return a watch that adds up the voltages of every pair sampled from now on."""
        watch = VoltageWatch(self._clock.monotonic(), self.calibration)
        self._watches.append(watch)
        return watch

    def _take(self, now: float) -> list[Pair]:
        """Return all new pairs; a deque needs no lock for that, so the tick never waits.

        In virtual time the driver may have run ahead: pairs that ended after `now` are left for the
        next read.
        """
        pairs = self._sampler.samples
        count = len(pairs)
        if self._thread is None:
            count = sum(pair.time <= now for pair in pairs)
        return [pairs.popleft() for _ in range(count)]

    def _catch_up(self, now: float) -> None:
        """Sample until `now` as the thread would have done in real time."""
        clock, sampler = self._clock, self._sampler
        while max(clock.monotonic(), sampler.ready_at) <= now - self._quiet_time - self._step_time:
            self._between_samples()
            self._step()
        clock.sleep(now - clock.monotonic())

    def _step(self) -> None:
        """Make one attempt, and update the longest recent time of an attempt, which decays slowly.

        An attempt longer than an eighth of a tick is an error, and counts as an eighth of a tick.
        """
        started = self._clock.monotonic()
        self._sampler.step()
        duration = min(self._clock.monotonic() - started, 0.125 * self._tick)
        self._step_time = max(duration, self._step_time + 0.01 * (duration - self._step_time))

    def _pause(self) -> float:
        """Return how long to pause, so that the tick need not wait for the interpreter [s].

        The pause is around an expected read: it ends some time after the read.
        """
        now = self._clock.monotonic()
        pause, late = self._sampler.ready_at - now, now - self._next_read
        if -self._quiet_time - self._step_time <= late < self._quiet_time:
            pause = max(pause, 0.25 * self._quiet_time - min(late, 0.0))
        return pause
