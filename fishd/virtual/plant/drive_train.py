"""Drive train from the instruction to the tail: the servo's delay, its wheel, and the cables.

The wheel follows φ̇ = Ω tanh((φ_c − φ)/Δ) of Fu et al., solved exactly for a constant φ_c. With the
lag x = (φ_c − φ)/Δ and the time t in units of Δ/Ω, sinh x(t) = sinh x(0) · exp(−t). Lags and times
of the wheel have those units here. Logarithms are used, because sinh overflows at a lag of 710.
"""

import math
from collections import deque
from typing import NamedTuple

from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.servo_law import Approach

_LN2 = math.log(2.0)
_MIN_PLAY_RAD = 1e-12
"""Smallest play that is not treated as zero [rad]."""
REVERSAL_FRACTION = 0.9
"""Fraction of the wheel's way after which a reversal counts as complete."""
MIN_HALF_BEAT_FRACTION, MAX_HALF_BEAT_FRACTION = 0.6, 0.8
"""Smallest and largest dwell, as fractions of a half beat of the best square wave."""


class Part(NamedTuple):
    """Part of a window with one instruction at the servo."""

    instruction_angle: float | None  # rad; None for no pulses
    begin: float  # s, from the start of the window
    end: float


class DelayLine:
    """Delay of instructions to the servo, which has no pulses before the first one arrives."""

    def __init__(self, delay: float) -> None:
        """`delay`: time from an instruction to the servo [s]."""
        self._delay = delay
        self._last_angle: float | None = None
        self._servo_angle: float | None = None
        self._delayed: deque[tuple[float, float | None]] = deque()
        """Times until arrival [s], and angles of the delayed instructions."""

    def advance(self, instruction_angle: float | None, duration: float) -> list[Part]:
        """Hold an instruction [rad] for `duration` s, and return the instructions at the servo."""
        if instruction_angle != self._last_angle:
            self._last_angle = instruction_angle
            self._delayed.append((self._delay, instruction_angle))
        parts, begin = [], 0.0
        while self._delayed and self._delayed[0][0] < duration:
            arrives, instruction_angle = self._delayed.popleft()
            if arrives > begin:
                parts.append(Part(self._servo_angle, begin, arrives))
            self._servo_angle, begin = instruction_angle, arrives
        parts.append(Part(self._servo_angle, begin, duration))
        # Rounded, so that only few different lengths of time occur.
        self._delayed = deque(
            (round(t - duration, 9), instruction_angle) for t, instruction_angle in self._delayed
        )
        return parts


def log_sinh(lag: float) -> float:
    """Return ln sinh |lag|, which is also the time until |sinh(lag)| = 1; −inf without a lag."""
    size = abs(lag)
    return size + math.log(-math.expm1(-2.0 * size)) - _LN2 if size else -math.inf


def relax(lag: float, time: float) -> float:
    """Return the lag to which `lag` has decreased after `time`."""
    exponent = log_sinh(lag) - time
    # Above 20, asinh(exp(y)) and y + ln 2 are the same double.
    size = math.asinh(math.exp(exponent)) if exponent < 20.0 else exponent + _LN2
    return math.copysign(size, lag)


def time_between(lag: float, later: float) -> float:
    """Return the time in which `lag` decreases to `later`, a smaller lag of the same sign."""
    return log_sinh(lag) - log_sinh(later)


def lag_after_reversal(step: float, half_period: float) -> float:
    """Return the lag right after a reversal of a periodic square wave.

    `step` is the full swing 2Φ/Δ. By antisymmetry, the lag at the end of a half period,
    sinh x · exp(−t), equals sinh(step − x), from which the next step starts; solved for x.
    """
    return 0.5 * (_log_add_exp(step, -half_period) - _log_add_exp(-step, -half_period))


def _log_add_exp(a: float, b: float) -> float:
    return max(a, b) + math.log1p(math.exp(-abs(a - b)))


class Pull(NamedTuple):
    """Coupling between wheel and fin during a part of the motion."""

    moves: bool
    """Whether the wheel moves the tail."""
    angle: float
    """Lag of the tail behind the wheel while it moves, otherwise the angle of the tail [rad]."""


class Cables:
    """Cables between wheel and tail, with slack and backlash."""

    def __init__(self, slack: float, play: float, phi: float) -> None:
        """slack, play: of the cables [rad]; phi: initial angle of wheel and tail [rad]"""
        self.taut = not (slack or play)
        self.tail = phi
        """Wheel angle that the tail follows; without backlash it equals φ [rad]."""
        self._slack = slack
        self._play = play

    def edges(self, phi: float, direction: float) -> list[float]:
        """Return the wheel angles (rad) after `phi` at which the wheel starts or stops to pull."""
        slack, play = self._slack, math.copysign(self._play, direction)
        edges = [play - slack, play + slack] if slack else []
        self.tail = self._followed(phi)
        if play and abs(self.tail + play - phi) > _MIN_PLAY_RAD:
            edges.append(self.tail + play)
        return edges

    def pull(self, halfway: float, end: float) -> Pull:
        """Turn the wheel to `end` (rad) without an edge in between, and return the coupling."""
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


def shortest_dwell(parameters: PlantParameters, amplitude: float) -> float:
    """Return the shortest useful time between two reversals: what one takes the servo [s].

    amplitude: Φ [rad]

    The fin sets bounds, so that a servo with a long delay can still perform the best square wave,
    and a fast servo cannot shake the fin. A half beat of that wave lasts π/ω₀ with a fast servo and
    2Φ/Ω with a slow one (Fu et al.), and longer in between.
    """
    p = parameters
    lag = 2.0 * amplitude / p.servo_lag
    left = (1.0 - REVERSAL_FRACTION) * lag
    if p.servo_law == "tanh":
        time = time_between(lag, left)
    else:
        time = Approach(p.servo_law, lag, 0.0).time_to(left)
    turn = p.servo_lag / p.servo_speed * time
    half_beat = max(math.pi / p.omega0, 2.0 * amplitude / p.servo_speed)
    dwell = max(p.servo_delay + turn, MIN_HALF_BEAT_FRACTION * half_beat)
    return min(dwell, MAX_HALF_BEAT_FRACTION * half_beat)
