"""Measurement of the mean thrust of a swinging fin, without drift of the force sensor.

Over whole beats, thrust is proportional to the mean square of the fin velocity. The factor has
three sources: a measurement or rests, a model of the fish, and the ripple of F_x. A fin that swings
as α = A cos θ + B cos(3θ + β) gives

    −Kαα̈ = ½Kω² [A² + 9B² + A² cos 2θ] + 5Kω²AB [cos(2θ + β) + cos(4θ + β)] + 9B² …

With F₂ and F₄ the complex Fourier coefficients of the ripple from a reversal on, at which θ is not
0, P = Re(F₂z − F₄z²) = ¼Kω²A² at the z on the unit circle that makes it real, and the mean is
2P + 0.18 |F₄|²/P. This source is the least certain of the three.
"""

import cmath
import math
from collections import deque
from collections.abc import Iterable
from functools import reduce
from typing import NamedTuple

from fishd.core.signals import Observation

SETTLING_HALF_BEATS = 2
"""Number of half beats until a fin that was at rest swings."""
HALF_BEATS_PER_BEAT = 2
"""Number of half beats over which the thrust is averaged."""
MAX_AVERAGING_TIME_S = 4.0
"""Maximum time over which the displayed thrust is averaged [s]."""
MAX_RIPPLE_HALF_BEATS = 40
"""Number of half beats over which the ripple is averaged."""
FACTOR_HALF_BEATS = 12
"""Number of half beats after which a factor from rests or a measurement is kept."""
RIPPLE_DEVIATION = 0.15
"""Relative standard deviation of the factor from the ripple: two thirds of 40 random simulated
fish, at three amplitudes each, were within it."""
COARSE_RIPPLE_DEVIATION = 0.25
"""Relative standard deviation with at most eight ticks per beat, from which F₄ is unknown."""
MODEL_DEVIATION = 0.03
"""Relative standard deviation of the factor from a model."""
MAX_DISAGREEMENT = 3.0
"""Number of standard deviations by which two sources may differ; a larger difference means that one
is of another fish, or drifts."""
Z95 = 1.96
"""Half-width of a 95 % confidence interval, in standard deviations."""


class HalfBeat(NamedTuple):
    """Measurement of a half beat."""

    forces: list[float]
    """F_x of each tick [N]."""
    energy: float
    """Integral of the squared fin velocity."""
    lasts: float
    """Duration [s]."""


class ThrustGauge:
    """Gauge that processes each tick, and updates the thrust after each half beat."""

    def __init__(self, coefficient: float | None) -> None:
        """coefficient: factor from a model of the fish; None without a model"""
        self.latest: float | None = None
        """Thrust of the latest beat; None while unknown [N]."""
        self.thrust: float | None = None
        """Thrust of the latest beats [N]."""
        self.ci95: float | None = None
        """Half-width of the 95 % confidence interval of `thrust` [N]."""
        self._coefficient = coefficient
        self._side = 0.0
        self._skip = SETTLING_HALF_BEATS + 1  # the first half beat is incomplete
        self._forces: list[float] = []
        self._energy = self._lasts = 0.0
        """Energy and duration of the current half beat, as in `HalfBeat`."""
        self._halves: deque[HalfBeat] = deque()
        self._ripples: deque[tuple[complex, complex, float]] = deque(maxlen=MAX_RIPPLE_HALF_BEATS)
        """F₂, F₄ and the mean square of the fin velocity of each half beat."""
        self._shown: tuple[float, float] | None = None
        self._awaited = FACTOR_HALF_BEATS

    def update(self, observation: Observation) -> bool:
        """Process a tick; return True if a half beat ended before it."""
        angle = observation.instruction_angle or self._side
        side = -1.0 if angle < 0.0 else 1.0
        ended = side != self._side
        if ended:
            self._side = side
            self._close(observation)
            self._forces = []
            self._energy = self._lasts = 0.0
        self._forces.append(observation.fx)
        self._energy += observation.fin_velocity**2 * observation.dt
        self._lasts += observation.dt
        return ended

    def _close(self, observation: Observation) -> None:
        """Update the thrust with the completed half beat."""
        if self._skip:
            self._skip -= 1
            return
        self._halves.append(HalfBeat(self._forces, self._energy, self._lasts))
        while (
            len(self._halves) > HALF_BEATS_PER_BEAT
            and _totals(self._halves)[1] > MAX_AVERAGING_TIME_S
        ):
            self._halves.popleft()
        if len(self._halves) < HALF_BEATS_PER_BEAT:
            return
        latest = list(self._halves)[-HALF_BEATS_PER_BEAT:]
        power = _power(latest)
        if not power > 0.0:
            return
        forces = [force for half in latest for force in half.forces]
        self._ripples.append(
            (_fourier_coefficient(forces, 2), _fourier_coefficient(forces, 4), power)
        )
        estimate = self._factor(observation)
        if estimate is None:
            return
        factor, spread = estimate
        self.latest = factor * power
        self.thrust = factor * _power(list(self._halves)[len(self._halves) % HALF_BEATS_PER_BEAT :])
        self.ci95 = Z95 * spread * self.thrust

    def _factor(self, observation: Observation) -> tuple[float, float] | None:
        """Return the factor and its relative standard deviation; None while unknown."""
        model = (math.log(self._coefficient), MODEL_DEVIATION**2) if self._coefficient else None
        known: list[tuple[float, float]] = []
        for source in (self._of_ripple(), model, self._as_shown(observation)):
            if source:  # the ripple is of the current fish; the other sources may not be
                known.append(reduce(_widen_if_contradicted, known, source))
        if not known:
            return None
        weights = [1.0 / variance for _, variance in known]
        mean = sum(w * log for w, (log, _) in zip(weights, known, strict=True)) / sum(weights)
        return math.exp(mean), 1.0 / math.sqrt(sum(weights))

    def _as_shown(self, observation: Observation) -> tuple[float, float] | None:
        """Return logarithm and variance of the factor from rests or a measurement.

        fishd keeps updating that factor, also from changes of the amplitude. Here the amplitude
        depends on the factor, so that an error by drift would reinforce itself. Therefore the value
        is kept.
        """
        if observation.thrust_factor is None or observation.thrust_factor_ci95 is None:
            return None
        variance = (observation.thrust_factor_ci95 / observation.thrust_factor / Z95) ** 2
        if self._shown is None or self._awaited:
            self._shown = math.log(observation.thrust_factor), variance
            self._awaited -= 1
        log, before = self._shown
        return log, max(variance, before)

    def _of_ripple(self) -> tuple[float, float] | None:
        """Return logarithm and variance of the factor from the ripple."""
        f2, f4, power = 0j, 0j, 0.0
        for second, fourth, square in self._ripples:
            f2 += second
            f4 += fourth
            power += square
        f2, f4 = f2 / power, f4 / power
        factor = mean_of_ripple(f2, f4)
        count = len(self._ripples)
        if factor is None or count < 2:
            return None
        scatter = 0.0
        for second, _, square in self._ripples:
            scatter += abs(second - f2 * square) ** 2
        noise = scatter * count / (count - 1) / (abs(f2) * power) ** 2
        return math.log(factor), (RIPPLE_DEVIATION if f4 else COARSE_RIPPLE_DEVIATION) ** 2 + noise


def mean_of_ripple(f2: complex, f4: complex) -> float | None:
    """Return the mean of a force with these Fourier coefficients at two and four times the beat
    frequency; None if they are not those of a swinging fin."""
    if not f2:
        return None
    angle = -cmath.phase(f2)
    for _ in range(20):  # Newton's method
        z = cmath.exp(1j * angle)
        value, slope = f2 * z - f4 * z * z, 1j * (f2 * z - 2.0 * f4 * z * z)
        if not slope.imag:
            break
        angle -= max(-0.2, min(0.2, value.imag / slope.imag))
    z = cmath.exp(1j * angle)
    power = (f2 * z - f4 * z * z).real
    return 2.0 * power + 0.18 * abs(f4) ** 2 / power if power > 0.3 * abs(f2) else None


def _totals(halves: Iterable[HalfBeat]) -> tuple[float, float]:
    """Return the total energy and duration [s] of some half beats."""
    energy = lasts = 0.0
    for half in halves:
        energy += half.energy
        lasts += half.lasts
    return energy, lasts


def _power(halves: Iterable[HalfBeat]) -> float:
    energy, lasts = _totals(halves)
    return energy / lasts


def _fourier_coefficient(forces: list[float], order: int) -> complex:
    """Return a Fourier coefficient of a whole beat; 0 if the ticks are too long for it [N].

    Forces are means over windows, which reduces a coefficient by a sinc. The part of F_y that a
    turned sensor adds has odd orders only.
    """
    if 2 * order >= len(forces):
        return 0j
    share = math.pi * order / len(forces)
    total = 0j
    for k, force in enumerate(forces):
        total += force * cmath.exp(-1j * share * (2 * k + 1))
    return total / len(forces) * share / math.sin(share)


def _widen_if_contradicted(
    known: tuple[float, float], other: tuple[float, float]
) -> tuple[float, float]:
    """Return a source with a larger variance if another source contradicts it."""
    log, variance = known
    beyond = (log - other[0]) ** 2 - MAX_DISAGREEMENT**2 * (variance + other[1])
    return log, variance + max(0.0, beyond)
