"""The servo's delay: each instruction reaches it some time after it was given."""

from collections import deque
from typing import NamedTuple


class Part(NamedTuple):
    """A part of a window in which the servo knows one instruction."""

    angle: float | None  # rad; None for no pulses
    begin: float  # s, from the start of the window
    end: float


class DelayLine:
    """Instructions on their way to the servo; before the first one arrives, it has no pulses."""

    def __init__(self, delay: float) -> None:
        """`delay` in s."""
        self._delay = delay
        self._given: float | None = None
        self._known: float | None = None
        self._under_way: deque[tuple[float, float | None]] = deque()
        """Each with the time until it arrives [s]."""

    def passed(self, angle: float | None, duration: float) -> list[Part]:
        """Give an instruction [rad] for `duration` s; what the servo knows meanwhile."""
        if angle != self._given:
            self._given = angle
            self._under_way.append((self._delay, angle))
        parts, begin = [], 0.0
        while self._under_way and self._under_way[0][0] < duration:
            arrives, angle = self._under_way.popleft()
            if arrives > begin:
                parts.append(Part(self._known, begin, arrives))
            self._known, begin = angle, arrives
        parts.append(Part(self._known, begin, duration))
        # Rounded, so that the same few lengths of time come again and again.
        self._under_way = deque((round(t - duration, 9), angle) for t, angle in self._under_way)
        return parts
