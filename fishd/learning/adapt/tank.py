"""Counts the time in the tank while a rig swims and rests."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from fishd.control.reporting import Publisher
from fishd.core.signals import Event, Tick
from fishd.lab.rig import Rig
from fishd.lab.rig_recording import recorded


class Tank:
    """A rig, as `fishd.lab` uses them, that tells how long it has been used for."""

    def __init__(self, rig: Rig, used: float, progress: Callable[[float], None]) -> None:
        """
        used: before [s]
        progress: called with the time that is used, tick by tick [s]
        """
        self.name, self.tick, self.amplitude = rig.name, rig.tick, rig.amplitude
        self.unit, self.source, self.calibration = rig.unit, rig.source, rig.calibration
        self.listener: Publisher | None = None
        self.used = used
        """Time in the tank so far, also of a swim that was broken off [s]."""
        self._rig = rig
        self._progress = progress
        self._passed = self._whole = 0.0

    def describe(self, writer: Any) -> None:
        """As `Rig.describe`."""
        self._rig.describe(writer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """The rig is left by whoever has entered it."""

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """As `Rig.swim`."""
        with self._counted(seconds):
            return self._rig.swim(controller, parameters, seconds)

    def rest(self, seconds: float) -> list[Tick]:
        """As `Rig.rest`."""
        with self._counted(seconds):
            return self._rig.rest(seconds)

    @contextmanager
    def recorded(self, path: Path, note: str) -> Iterator[None]:
        """While this lasts, all that the rig does goes into a recording; raises as that does."""
        with recorded(self, path, note):
            yield

    @contextmanager
    def _counted(self, seconds: float) -> Iterator[None]:
        self._passed, self._whole = 0.0, seconds
        self._rig.listener = _Counting(self)
        try:
            yield
            self._passed = seconds
        finally:
            self._rig.listener = None
            self.used += self._passed
            self._passed = 0.0

    def count(self) -> None:
        """One more tick has come."""
        self._passed = min(self._whole, self._passed + self.tick)
        self._progress(self.used + self._passed)


class _Counting:
    """Hands on ticks and events, and counts."""

    def __init__(self, tank: Tank) -> None:
        self._tank = tank

    def tick(self, tick: Tick) -> None:
        self._tank.count()
        if self._tank.listener:
            self._tank.listener.tick(tick)

    def event(self, event: Event) -> None:
        if self._tank.listener:
            self._tank.listener.event(event)
