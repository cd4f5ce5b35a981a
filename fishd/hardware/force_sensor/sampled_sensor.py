"""The dual force sensor, whatever its driver: a thread samples it, the tick takes what came in.

In virtual time there is no thread: a read samples until its clock has come to the tick.
"""

import math
import threading
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from fishd.core.calibration import ForceCalibration
from fishd.core.clock import Clock
from fishd.core.errors import SensorError
from fishd.core.signals import Measurement
from fishd.hardware.driver import ForceSensorDriver, Pair, survived
from fishd.hardware.force_sensor.window import VoltageWatch, WindowEvaluation
from fishd.hardware.sampler import Sampler

HOLD = 2.2e-3
"""How long before a read all conversions have ended, at most an eighth of a tick [s].

As long as the ticker is awake before a deadline: two threads of one interpreter delay each other.
"""
CLOSE_LIMIT = 0.5
"""How long to wait for the thread to end [s]."""


class SampledSensor:
    """A force sensor that measures voltages, and can be calibrated.

    What is read, watched and calibrated is for one thread, the one that ticks.
    """

    def __init__(
        self,
        driver: ForceSensorDriver[Any],
        calibration: ForceCalibration,
        clock: Clock,
        *,
        threaded: bool,
        tick: float,
        beside: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin to sample; hardware that is missing may come later.

        clock: of the driver; in virtual time one of its own, which reads move on
        threaded: sample in a thread, which needs a clock that moves by itself
        tick: time between two reads [s]
        beside: called again and again in virtual time, for what else uses its clock
        """
        self.calibration = calibration
        """What turns voltages into forces."""
        self._clock = clock
        self._tick = tick
        self._hold = min(HOLD, 0.125 * tick)
        self._step_time = 0.0
        self._beside = beside
        self._place = driver.place
        self._transport = driver.transport
        self._driver = driver
        self._sampler: Sampler[Pair] = Sampler(driver, clock)
        self._evaluation = WindowEvaluation(driver.settings, driver.names, driver.raw_unit)
        self._latest: Measurement | None = None
        self._watches: list[VoltageWatch] = []
        self._next_read = math.inf
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name="force-sampler", daemon=True)
            self._thread.start()

    def recalibrate(self, calibration: ForceCalibration) -> None:
        """Use another calibration from the next read on."""
        self.calibration = calibration

    def read(self, now: float) -> Measurement:
        """What was measured since the previous read; in real time it waits for nothing.

        Without a new pair of samples it is the previous measurement, its time included, of no
        samples and under no suspicion. Raises `SensorError`, with what to check, while the hardware
        cannot be read, before the first pair, and once closed.
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
            self._latest = replace(measurement, samples=0, suspect="", extremes=None)
            return measurement
        if trouble := self._sampler.trouble:
            self._evaluation.interrupt()
            raise SensorError(trouble)
        if self._latest is None:
            raise SensorError(f"{self._place} has not delivered yet")
        return self._latest

    @property
    def unit(self) -> str:
        """Of the forces: N, or that of the driver until the sensor is calibrated."""
        return self._evaluation.unit(self.calibration)

    def watch(self) -> VoltageWatch:
        """Begin to add up the voltages of every pair that is sampled from now on."""
        watch = VoltageWatch(self._clock.monotonic(), self.calibration)
        self._watches.append(watch)
        return watch

    def counters(self) -> dict[str, int]:
        """Errors that were survived, since start."""
        sampler, transport = self._sampler, self._transport
        return {
            f"{transport}_errors": sampler.errors,
            f"{transport}_reconnects": sampler.reconnects,
            **survived(self._driver),
        }

    def close(self) -> None:
        """Stop to sample and let go of the hardware; may be called twice, and never hangs.

        A thread that is stuck in a transfer is left to end by itself.
        """
        self._closing.set()
        if self._thread is None:
            self._sampler.close()
        else:
            self._thread.join(CLOSE_LIMIT)

    def _take(self, now: float) -> list[Pair]:
        """All that has come in; a deque needs no lock for that, so the tick waits for nobody.

        In virtual time the driver may have run ahead: what ended after `now` is for the next read.
        """
        pairs = self._sampler.samples
        count = len(pairs)
        if self._thread is None:
            count = sum(pair.time <= now for pair in pairs)
        return [pairs.popleft() for _ in range(count)]

    def _catch_up(self, now: float) -> None:
        """Sample until `now` as the thread would have done."""
        clock, sampler = self._clock, self._sampler
        while max(clock.monotonic(), sampler.ready_at) <= now - self._hold - self._step_time:
            self._beside()
            self._step()
        clock.sleep(now - clock.monotonic())

    def _step(self) -> None:
        """Make one attempt, and learn how long that takes: the longest of late, slowly forgotten.

        What takes longer than an eighth of a tick is no sample but an error.
        """
        begun = self._clock.monotonic()
        self._sampler.step()
        took = min(self._clock.monotonic() - begun, 0.125 * self._tick)
        self._step_time = max(took, self._step_time + 0.01 * (took - self._step_time))

    def _run(self) -> None:
        """Sample until closed; what the thread does."""
        clock, sampler = self._clock, self._sampler
        while not self._closing.is_set():
            pause = max(sampler.ready_at - clock.monotonic(), self._pause())
            if pause > 0.0:
                self._closing.wait(pause)
            else:
                self._step()
        sampler.close()

    def _pause(self) -> float:
        """How long to stay quiet, so that the tick does not have to wait for the interpreter [s].

        That is around an expected read, until it has come and had some time.
        """
        late = self._clock.monotonic() - self._next_read
        if not -self._hold - self._step_time <= late < self._hold:
            return 0.0
        return 0.25 * self._hold - min(late, 0.0)
