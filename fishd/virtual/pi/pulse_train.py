"""A pin that sends pulses: which width it has when, frame by frame; for the pigpiod."""

import math
from collections import deque
from typing import NamedTuple

SERVO_FRAME = 0.02
"""Time from one servo pulse to the next [s]."""


class Pulses(NamedTuple):
    """One entry of the log: from `time` [s] on, pulses of `width` [µs], one per `frame` [s]."""

    time: float
    width: float
    frame: float


class PulseTrain:
    """The pulses of one pin; frames begin at whole multiples of their length.

    Times are seconds of one clock and must not go back from call to call; not safe to use from
    several threads.
    """

    KEPT = 2048
    """How many changes are remembered."""

    def __init__(self) -> None:
        self._log: deque[Pulses] = deque(maxlen=self.KEPT)

    @property
    def history(self) -> list[tuple[float, float]]:
        """(time, width) of the last changes, each at the moment it took effect [s, µs]."""
        return [(entry.time, entry.width) for entry in self._log]

    def set(self, time: float, width: float, frame: float = SERVO_FRAME) -> None:
        """From the first frame that begins at or after `time`: this width [µs]; 0 is no pulses."""
        before = self.at(time)
        # What is going on ends with its own frame; out of silence the new frames can begin.
        boundary = _frame_end(time, before.frame if before.width else frame)
        self._forget_after(boundary)
        self._append(Pulses(boundary, width, frame))

    def cut(self, time: float) -> None:
        """No pulses from now on [s]; one that is under way ends here, shorter than it should be."""
        now = self.at(time)
        self._forget_after(math.nextafter(time, math.inf))
        elapsed = (time - _frame_start(time, now.frame)) * 1e6
        if elapsed < now.width:
            self._append(Pulses(time, elapsed, now.frame))
        self._append(Pulses(_frame_end(time, now.frame), 0.0, now.frame))

    def at(self, time: float) -> Pulses:
        """The entry that holds at a time [s]; before the first one there are no pulses."""
        for entry in reversed(self._log):
            if entry.time <= time:
                return entry
        return Pulses(-math.inf, 0.0, SERVO_FRAME)

    def width(self, time: float) -> float:
        """The width at a time [µs]; 0 is no pulses."""
        return self.at(time).width

    def level(self, time: float) -> int:
        """The level of the pin at a time: 1 during a pulse."""
        now = self.at(time)
        if now.width >= now.frame * 1e6:
            return 1
        return int(time - _frame_start(time, now.frame) < now.width * 1e-6 - _EDGE)

    def _forget_after(self, time: float) -> None:
        while self._log and self._log[-1].time >= time:
            self._log.pop()

    def _append(self, entry: Pulses) -> None:
        last = self._log[-1] if self._log else Pulses(-math.inf, 0.0, entry.frame)
        if (last.width, last.frame) != (entry.width, entry.frame):
            self._log.append(entry)


# A time that was computed as a multiple of the frame must count as one, and the end of a pulse as
# its end, up to this share of a frame and this time [s].
_ROUNDING = 1e-6
_EDGE = 1e-9


def _frame_start(time: float, frame: float) -> float:
    return math.floor(time / frame + _ROUNDING) * frame


def _frame_end(time: float, frame: float) -> float:
    end = math.ceil(time / frame - _ROUNDING) * frame
    return end if end - time > _ROUNDING * frame else time
