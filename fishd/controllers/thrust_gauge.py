"""The mean thrust of a swinging fin, from what no drift of the force sensor touches.

Over whole beats, thrust is proportional to the mean square of the fin velocity. What it has to be
multiplied by, the factor, is told by three: a measurement or rests, a model of the fish, and the
ripple of F_x. A fin that swings as α = A cos θ + B cos(3θ + β) gives

    −Kαα̈ = ½Kω² [A² + 9B² + A² cos 2θ] + 5Kω²AB [cos(2θ + β) + cos(4θ + β)] + 9B² …

With F₂ and F₄ the complex Fourier coefficients of the ripple from a reversal on, which is not where
θ is 0, P = Re(F₂z − F₄z²) = ¼Kω²A² at the z on the unit circle that makes it real, and the mean is
2P + 0.18 |F₄|²/P. Knowing less, this is the least certain of the three.
"""

import cmath
import math
from collections import deque
from collections.abc import Iterable
from functools import reduce
from typing import NamedTuple

from fishd.core.signals import Observation

SETTLES = 2
"""Half beats until a fin that was at rest swings."""
BEAT = 2
"""Half beats that the thrust is taken over."""
SHOWN = 4.0
"""The thrust that is shown is that of the latest beats, of no more than this in all [s]."""
REMEMBERS = 40
"""Half beats that the ripple is taken over."""
KEPT = 12
"""Half beats after which a factor that rests have shown is kept as it is."""
RIPPLE = 0.15
"""Standard deviation of the factor that it gives, a share of it: two thirds of 40 random simulated
fish, at three amplitudes each, were nearer."""
COARSE = 0.25
"""That where a beat has eight ticks at most, and F₄ cannot be told."""
MODEL = 0.03
"""Standard deviation of the factor of a model, a share of it."""
CONTRADICTS = 3.0
"""Two sources may differ by so many standard deviations; else one is of another fish, or drifts."""
INTERVAL = 1.96
"""Half of a 95 % interval, over the standard deviation."""


class Half(NamedTuple):
    """A half beat."""

    forces: list[float]
    """F_x [N]."""
    energy: float
    """Integral of the squared fin velocity."""
    lasts: float
    """[s]"""


class ThrustGauge:
    """Told of each tick; knows the thrust after each half beat."""

    def __init__(self, coefficient: float | None) -> None:
        """coefficient: the factor, by a model of the fish; None without a model"""
        self.latest: float | None = None
        """Thrust of the latest beat; None while not known [N]."""
        self.thrust: float | None = None
        """Thrust of the latest beats [N]."""
        self.error: float | None = None
        """Half of its 95 % interval [N]."""
        self._coefficient = coefficient
        self._side = 0.0
        self._skip = SETTLES + 1  # the first one began before anybody looked
        self._forces: list[float] = []
        self._energy = self._lasts = 0.0
        """Of the open half beat, as in `Half`."""
        self._halves: deque[Half] = deque()
        self._ripples: deque[tuple[complex, complex, float]] = deque(maxlen=REMEMBERS)
        """F₂, F₄ and the mean square of the fin velocity."""
        self._shown: tuple[float, float] | None = None
        self._awaited = KEPT

    def update(self, seen: Observation) -> bool:
        """Take in a tick; True where a half beat ended before it."""
        angle = seen.instruction_angle or self._side
        side = -1.0 if angle < 0.0 else 1.0
        ended = side != self._side
        if ended:
            self._side = side
            self._close(seen)
            self._forces = []
            self._energy = self._lasts = 0.0
        self._forces.append(seen.fx)
        self._energy += seen.fin_velocity**2 * seen.dt
        self._lasts += seen.dt
        return ended

    def _close(self, seen: Observation) -> None:
        """Learn from the half beat that has ended."""
        if self._skip:
            self._skip -= 1
            return
        self._halves.append(Half(self._forces, self._energy, self._lasts))
        while len(self._halves) > BEAT and _totals(self._halves)[1] > SHOWN:
            self._halves.popleft()
        if len(self._halves) < BEAT:
            return
        latest = list(self._halves)[-BEAT:]
        power = _power(latest)
        if not power > 0.0:
            return
        forces = [force for half in latest for force in half.forces]
        self._ripples.append((_coefficient(forces, 2), _coefficient(forces, 4), power))
        found = self._factor(seen)
        if found is None:
            return
        factor, spread = found
        self.latest = factor * power
        self.thrust = factor * _power(list(self._halves)[len(self._halves) % BEAT :])
        self.error = INTERVAL * spread * self.thrust

    def _factor(self, seen: Observation) -> tuple[float, float] | None:
        """The factor, and its standard deviation as a share of it; None while nothing is known."""
        model = (math.log(self._coefficient), MODEL**2) if self._coefficient else None
        known: list[tuple[float, float]] = []
        for source in (self._of_ripple(), model, self._as_shown(seen)):
            if source:  # the ripple is of this fish as it is now, and the others may not be
                known.append(reduce(_trusted, known, source))
        if not known:
            return None
        weights = [1.0 / variance for _, variance in known]
        mean = sum(w * log for w, (log, _) in zip(weights, known, strict=True)) / sum(weights)
        return math.exp(mean), 1.0 / math.sqrt(sum(weights))

    def _as_shown(self, seen: Observation) -> tuple[float, float] | None:
        """Logarithm of the factor as rests or a measurement have shown it, and its variance.

        fishd goes on learning it, from changes of the amplitude as well. But here the amplitude
        follows from the factor: an error of it, by drift, would confirm itself. So it is kept.
        """
        if seen.thrust_factor is None or seen.thrust_factor_error is None:
            return None
        variance = (seen.thrust_factor_error / seen.thrust_factor / INTERVAL) ** 2
        if self._shown is None or self._awaited:
            self._shown = math.log(seen.thrust_factor), variance
            self._awaited -= 1
        log, before = self._shown
        return log, max(variance, before)

    def _of_ripple(self) -> tuple[float, float] | None:
        """Logarithm of the factor by the ripple, and its variance."""
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
        return math.log(factor), (RIPPLE if f4 else COARSE) ** 2 + noise


def mean_of_ripple(f2: complex, f4: complex) -> float | None:
    """Mean of a force with these Fourier coefficients at two and four times the beat; or None."""
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


def _totals(halves: Iterable[Half]) -> tuple[float, float]:
    """Return the energy of some half beats, and how long they last [s]."""
    energy = lasts = 0.0
    for half in halves:
        energy += half.energy
        lasts += half.lasts
    return energy, lasts


def _power(halves: Iterable[Half]) -> float:
    energy, lasts = _totals(halves)
    return energy / lasts


def _coefficient(forces: list[float], order: int) -> complex:
    """Of the Fourier series of a whole beat; 0 where the ticks are too long for it [N].

    Forces are means over windows, which are smaller by a sinc. What a turned sensor mixes in of F_y
    is of odd orders only.
    """
    if 2 * order >= len(forces):
        return 0j
    share = math.pi * order / len(forces)
    total = 0j
    for k, force in enumerate(forces):
        total += force * cmath.exp(-1j * share * (2 * k + 1))
    return total / len(forces) * share / math.sin(share)


def _trusted(known: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """What is known is less certain where another source speaks clearly against it."""
    log, variance = known
    beyond = (log - other[0]) ** 2 - CONTRADICTS**2 * (variance + other[1])
    return log, variance + max(0.0, beyond)
