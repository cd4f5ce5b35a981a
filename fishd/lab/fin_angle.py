"""Fin angles that a camera measures during an experiment, and their maximum in swims."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fishd.camera.tail.beats import average, find_maxima
from fishd.core import text
from fishd.core.signals import Event, Tick
from fishd.core.tail_reading import RecordedTail
from fishd.lab.error_budget import settled_phases
from fishd.recording import open_run

if TYPE_CHECKING:
    from fishd.recording.recorder import FrameSource

_MAX_UNKNOWN = 0.1
"""Largest fraction of unknown fin angles in swims without a warning: beats without them may differ
from others."""
_MAX_WAITING = 4096
"""Largest number of fin angles that wait for a recording; older ones are dropped."""


class FinAngles:
    """The fin angles of an experiment: a listener of its session, which takes them at each tick."""

    def __init__(self, camera: "FrameSource", warn: Callable[[str], None]) -> None:
        """warn: called with a line for the user per change of the camera's state"""
        self._camera, self._warn = camera, warn
        self._readings: list[tuple[float, float | None, str]] = []
        """Unix time [s], fin angle [rad], and the reason why it is unknown."""
        self._waiting: deque[RecordedTail] = deque(maxlen=_MAX_WAITING)

    def tick(self, tick: Tick) -> None:
        """Take the fin angles that have come."""
        self._camera.set_time(tick.t, tick.time)
        for line in self._camera.take()[0]:
            self._warn(line)
        tails = self._camera.take_tails()
        self._waiting += tails
        self._add(tails)

    def event(self, event: Event) -> None:
        """Ignore an event."""

    def read(self, recordings: Iterable[Path]) -> None:
        """Add the fin angles of recordings of the same experiment; raises `RecordingError`."""
        for path in recordings:
            self._add(open_run(path).tails)

    def take_new(self) -> list[RecordedTail]:
        """Return those that have come since the previous call, for a recording."""
        tails = list(self._waiting)
        self._waiting.clear()
        return tails

    def find_maximum(self, ticks: Sequence[Tick], settle: float) -> dict[str, Any]:
        """Return the fields of a `Thrust` about the fin angle.

        For fewer than two beats, return none. Warn with the reason if many are unknown.

        ticks: of swims and rests; settle: time until a swim is steady [s]
        """
        beats, reasons, count = [], Counter[str](), 0
        for swim in settled_phases(ticks, settle, swims=True):
            if swim:
                begin, end = swim[0].t, swim[-1].t
                inside = [reading for reading in self._readings if begin <= reading[0] <= end]
                count += len(inside)
                reasons.update(reason for _, alpha, reason in inside if alpha is None)
                times, angles, _ = zip(*inside, strict=True) if inside else ((), (), ())
                beats += find_maxima(times, angles)
        maximum, unknown = average(beats), reasons.total()
        if maximum is None or unknown > _MAX_UNKNOWN * count:
            (reason, _), *_ = reasons.most_common(1) or [("the camera sends too few", 0)]
            self._warn(f"{unknown} of {count} fin angles are unknown: {text.line(reason)}")
        if maximum is None:
            return {}
        return dict(zip(("fin_angle_max", "fin_angle_max_ci95"), maximum, strict=True))

    def _add(self, tails: Iterable[RecordedTail]) -> None:
        self._readings += [(tail.t, tail.alpha, tail.reason) for tail in tails]
