"""Pulses of a pin of pigpiod: their widths over time, frame by frame."""

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

SERVO_FRAME = 0.02
"""Period of servo pulses [s]."""


class Pulses(NamedTuple):
    """Entry of the log: from `time` [s] on, pulses of `width` [µs], one per `frame` [s]."""

    time: float
    width: float
    frame: float


class Edge(NamedTuple):
    """Change of the level of a pin."""

    time: float
    """[s]"""
    level: int


class PulseTrain:
    """Pulses of one pin; frames begin at whole multiples of their length.

    Times are seconds of one clock and must not decrease from call to call; not safe for use from
    several threads.
    """

    MAX_CHANGES = 2048
    """Number of changes in the log."""

    def __init__(self) -> None:
        self._log: deque[Pulses] = deque(maxlen=self.MAX_CHANGES)

    @property
    def history(self) -> list[tuple[float, float]]:
        """Times and widths of the latest changes, at the times they took effect [s, µs]."""
        return [(entry.time, entry.width) for entry in self._log]

    def set(self, time: float, width: float, frame: float = SERVO_FRAME) -> None:
        """Set the width [µs] from the first frame at or after `time` [s]; 0 stops the pulses."""
        before = self.at(time)
        # A running frame is completed; without pulses, the new frames begin on their own grid.
        boundary = _frame_end(time, before.frame if before.width else frame)
        self._forget_after(boundary)
        self._append(Pulses(boundary, width, frame))

    def cut(self, time: float) -> None:
        """Stop the pulses at a time [s]; a running pulse ends early."""
        now = self.at(time)
        self._forget_after(math.nextafter(time, math.inf))
        elapsed = (time - _frame_start(time, now.frame)) * 1e6
        if elapsed < now.width:
            self._append(Pulses(time, elapsed, now.frame))
        self._append(Pulses(_frame_end(time, now.frame), 0.0, now.frame))

    def at(self, time: float) -> Pulses:
        """Return the entry at a time [s]; width 0 before the first one."""
        for entry in reversed(self._log):
            if entry.time <= time:
                return entry
        return Pulses(-math.inf, 0.0, SERVO_FRAME)

    def width(self, time: float) -> float:
        """Return the width at a time [µs]; 0 without pulses."""
        return self.at(time).width

    def level(self, time: float) -> int:
        """Return the level of the pin at a time: 1 during a pulse."""
        now = self.at(time)
        if now.width >= now.frame * 1e6:
            return 1
        return int(time - _frame_start(time, now.frame) < now.width * 1e-6 - _EDGE_TOLERANCE_S)

    def edges(self, begin: float, end: float) -> Iterator[Edge]:
        """Yield the edges from `begin` to before `end` [s], which is not in the future."""
        entries = list(self._log)
        ends = [entry.time for entry in entries[1:]] + [end]
        for entry, entry_end in zip(entries, ends, strict=False):  # there may be no entries
            first, last = max(begin, entry.time), min(end, entry_end)
            if not entry.width or first >= last:
                continue
            frame = math.floor(first / entry.frame + _FRAME_TOLERANCE)
            while (start := frame * entry.frame) < last:
                for edge in (Edge(start, 1), Edge(start + entry.width * 1e-6, 0)):
                    if first <= edge.time < last:
                        yield edge
                frame += 1

    def _forget_after(self, time: float) -> None:
        while self._log and self._log[-1].time >= time:
            self._log.pop()

    def _append(self, entry: Pulses) -> None:
        last = self._log[-1] if self._log else Pulses(-math.inf, 0.0, entry.frame)
        if (last.width, last.frame) != (entry.width, entry.frame):
            self._log.append(entry)


# Tolerances for rounding errors: of the begin of a frame, as a fraction of it, and of the end of a
# pulse [s].
_FRAME_TOLERANCE = 1e-6
_EDGE_TOLERANCE_S = 1e-9


def _frame_start(time: float, frame: float) -> float:
    return math.floor(time / frame + _FRAME_TOLERANCE) * frame


def _frame_end(time: float, frame: float) -> float:
    end = math.ceil(time / frame - _FRAME_TOLERANCE) * frame
    return end if end - time > _FRAME_TOLERANCE * frame else time
