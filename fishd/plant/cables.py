"""What the cables between wheel and tail take off the wheel's motion: backlash, then slack."""

import math
from typing import NamedTuple

_ENGAGED = 1e-12  # rad; play that is smaller is none


class Pull(NamedTuple):
    """What the fin feels of the wheel during a stretch of its motion."""

    moves: bool
    angle: float
    """Where it moves, how far it is behind the wheel, else where it stands [rad]."""


class Cables:
    """Remembers where the tail is within its play, and tells what it feels of the wheel."""

    def __init__(self, slack: float, play: float, phi: float) -> None:
        """The tail follows the wheel, at `phi`; all in rad."""
        self.taut = not (slack or play)
        self.tail = phi
        """The wheel angle that the tail follows; only with backlash another than φ [rad]."""
        self._slack = slack
        self._play = play

    def edges(self, phi: float, direction: float) -> list[float]:
        """Wheel angles (rad) at which a wheel that turns on from `phi` begins or ceases to pull."""
        slack, play = self._slack, math.copysign(self._play, direction)
        edges = [play - slack, play + slack] if slack else []
        self.tail = self._followed(phi)
        if play and abs(self.tail + play - phi) > _ENGAGED:
            edges.append(self.tail + play)
        return edges

    def pull(self, halfway: float, end: float) -> Pull:
        """Let the wheel turn to `end` (rad), with no edge on its way."""
        before, tail = self.tail, self._followed(halfway)
        self.tail = self._followed(end)
        if abs(tail) <= self._slack:
            return Pull(False, 0.0)
        slack = math.copysign(self._slack, tail)
        if self._play and tail == before:
            return Pull(False, tail - slack)
        return Pull(True, halfway - tail + slack)

    def _followed(self, phi: float) -> float:
        return max(phi - self._play, min(phi + self._play, self.tail)) if self._play else phi
