"""From an instruction to the tail: the servo's delay, its wheel, and the cables with their play.

The wheel follows φ̇ = Ω tanh((φ_c − φ)/Δ) of Fu et al., solved exactly for a constant φ_c. With the
lag x = (φ_c − φ)/Δ and the time t in units of Δ/Ω, sinh x(t) = sinh x(0) · exp(−t). Lags and times
of the wheel are in those units here, and in logarithms, because sinh overflows at a lag of 710.
"""

import math
from collections import deque
from typing import NamedTuple

_LN2 = math.log(2.0)
_ENGAGED = 1e-12  # rad; play that is smaller is none


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


def log_sinh(lag: float) -> float:
    """Return ln sinh |lag|, which is also the time until |sinh(lag)| = 1; −inf without a lag."""
    size = abs(lag)
    return size + math.log(-math.expm1(-2.0 * size)) - _LN2 if size else -math.inf


def relax(lag: float, time: float) -> float:
    """Return the lag that is left of `lag` after `time`."""
    exponent = log_sinh(lag) - time
    # Above 20, asinh(exp(y)) and y + ln 2 are the same double.
    size = math.asinh(math.exp(exponent)) if exponent < 20.0 else exponent + _LN2
    return math.copysign(size, lag)


def time_between(lag: float, later: float) -> float:
    """Return the time in which `lag` shrinks to `later`, a smaller lag of the same sign."""
    return log_sinh(lag) - log_sinh(later)


def lag_after_reversal(step: float, half_period: float) -> float:
    """Return the lag right after a reversal of a periodic square wave.

    `step` is the full swing 2Φ/Δ. The lag left at the end of a half period, sinh x · exp(−t), is
    what the next step starts from, sinh(step − x), by antisymmetry; solved here for x.
    """
    return 0.5 * (_log_add_exp(step, -half_period) - _log_add_exp(-step, -half_period))


def _log_add_exp(a: float, b: float) -> float:
    return max(a, b) + math.log1p(math.exp(-abs(a - b)))


class Pull(NamedTuple):
    """How the wheel drives the fin during a part of its motion."""

    moves: bool
    angle: float
    """Where it moves, how far it is behind the wheel, else where it stands [rad]."""


class Cables:
    """Remembers where the tail is within its play, and how the wheel drives it."""

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
