"""The readings of the sensors in each tick, and what is reported of sensors that fail."""

from collections import deque
from collections.abc import Sequence

from fishd.control.reporting import Reporter
from fishd.control.supervisor import Supervisor
from fishd.core.signals import ReadingState
from fishd.hardware.base import Sensor

MEAN_SPAN_S = 2.0
"""Time over which the shown readings are averaged, a few tail beats [s]."""


class Readings:
    """The reader of all sensors, called in each tick; the fish swims on without their readings."""

    def __init__(
        self,
        sensors: Sequence[Sensor],
        reporter: Reporter,
        supervisor: Supervisor,
        tick: float,
        now: float,
    ) -> None:
        """tick: period of the loop [s]; now: time of the start [s, monotonic]"""
        self.sensors = sensors
        self.declared = {
            name: reading for sensor in sensors for name, reading in sensor.declared.items()
        }
        """All readings by name."""
        self.latest: dict[str, float] = {}
        """Readings of the latest tick by name, without old ones."""
        self.troubles: dict[str, str] = {}
        """Lines on what is wrong with the readings, by sensor."""
        self._silent: set[str] = set()
        """Names of the sensors with an old reading."""
        self._has_required = any(sensor.required for sensor in sensors)
        self._reporter = reporter
        self._supervisor = supervisor
        self._start = now
        self._recent: deque[dict[str, float]] = deque(maxlen=max(1, round(MEAN_SPAN_S / tick)))

    def read(self, now: float) -> dict[str, float]:
        """Return the readings by name, without old ones; never raises, and waits for no sensor.

        now: start of the tick [s, monotonic]
        """
        readings: dict[str, float] = {}
        in_doubt = False
        for sensor in self.sensors:
            for name, (time, value) in sensor.read().items():
                if now - time <= sensor.stale_after:
                    readings[name] = value
            if sensor.doubts:
                in_doubt = True
        self.latest = readings
        self._recent.append(readings)
        if in_doubt or self.troubles or len(readings) < len(self.declared):
            self._report(now)
        if self._has_required:
            lost = (s.name for s in self.sensors if s.required and s.name in self._silent)
            problem = next((self.troubles[name] for name in lost), None)
            self._supervisor.check("sensor-lost", problem)
        return readings

    def states(self, now: float) -> dict[str, ReadingState]:
        """Return every reading with its description, its mean and its age at a time."""
        states = {}
        for sensor in self.sensors:
            samples = sensor.read()
            for name, reading in sensor.declared.items():
                recent = [row[name] for row in self._recent if name in row]
                is_old = name not in self.latest
                time, _ = samples.get(name, (None, None))
                states[name] = ReadingState(
                    unit=reading.unit,
                    description=reading.description,
                    low=reading.low,
                    high=reading.high,
                    sensor=sensor.name,
                    value=None if is_old else sum(recent) / len(recent),
                    age=None if time is None else max(0.0, now - time),
                    problem=self.troubles.get(sensor.name) if is_old else sensor.doubts.get(name),
                )
        return states

    def _report(self, now: float) -> None:
        """Report each sensor once that gives no reading, or a doubtful one, and its recovery."""
        for sensor in self.sensors:
            name, doubts = sensor.name, "; ".join(sensor.doubts.values())
            was_silent, before = name in self._silent, self.troubles.pop(name, None)
            self._silent.discard(name)
            if gap := self._find_gap(sensor, now):
                self._silent.add(name)
                reason = sensor.trouble or doubts or "it does not answer"
                self.troubles[name] = f"sensors.{name} gives {gap}: {reason}"
                if not was_silent:
                    self._reporter.event("sensor", self.troubles[name], "warning", sensor=name)
            elif doubts:
                self.troubles[name] = f"sensors.{name}: {doubts}"
                if before is None:
                    self._reporter.event("sensor", self.troubles[name], "warning", sensor=name)
            elif before is not None:
                message = f"sensors.{name} gives good readings again"
                self._reporter.event("sensor", message, sensor=name)

    def _find_gap(self, sensor: Sensor, now: float) -> str | None:
        """Return which readings are old, and since when, in words; None if none is."""
        samples = sensor.read()
        times = {name: samples.get(name, (self._start, 0.0))[0] for name in sensor.declared}
        old = {name: now - t for name, t in times.items() if now - t > sensor.stale_after}
        return f"no {', '.join(old)} for {max(old.values()):.3g} s" if old else None
