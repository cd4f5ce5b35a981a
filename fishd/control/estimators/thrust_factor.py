"""The ratio of thrust to power of a swimming fish, from changes of the force.

The force of some whole beats is zero + factor · power + noise, where power is their mean square of
`fin_velocity`. Only the difference of two forces, before and after a change of the power, depends
on the factor but not on the zero. `Factor.after_step` updates it from one such difference.
"""

import math
from typing import Any, NamedTuple

FACTOR_WALK = 0.00025
"""Standard deviation by which the true factor changes in a second, as a fraction of it [1/√s]:
1.5 % in an hour."""
WAVE_SCATTER = 0.3
"""Standard deviation of the factor from one wave to another, as a fraction of it. It is as large as
that where `estimator.leak` is not that of the fish."""
SIZE_SCATTER = 0.12
"""Standard deviation of the factor for each e-fold of the fin's speed or of the frequency, as a
fraction of it: root mean square of 40 random simulated fish."""
CONTRADICTION_SIGMAS = 1.5
"""Number of standard deviations beyond which a change of the force contradicts the factor of the
same wave; twice as many contradict that of another wave, which is rougher."""
UNKNOWN_THRUST_SD_N = 1.0
"""Standard deviation of a thrust of which nothing is known [N]."""
NEAR_COMPARISONS = 8
"""Number of comparisons from which the drift near a change is taken, before it and after it: about
5 s of a swim."""
CLEAR_DRIFT_SIGMAS = 2.0
"""Number of standard deviations of the noise beyond which a change of the force is a drift."""
MEMORY_COMPARISONS = 64
"""Number of comparisons that the drift is averaged over: about 40 s."""
PRIOR_COMPARISONS = 12
"""Number of comparisons for which the configured drift counts: as many others halve it, if they
show none."""
NOISE_PART = 1.5
"""Part of the noise of a block that is subtracted from each comparison; white noise would be 2."""
DRIFT_LAG_S = 2.5
"""Time over which the drift is observed, about that from a rest to a steady swim [s]."""

Wave = tuple[str, dict[str, Any]]
"""A controller's name, and its parameters."""


class Level(NamedTuple):
    """Means over some consecutive blocks of a swim or of a rest."""

    force: float
    """Mean F_x [N]."""
    variance: float
    """Variance of `force` by noise [N²]."""
    power: float
    """Mean square of `fin_velocity`; 0 at rest."""
    size: complex | None
    """Logarithm of the fin's speed, and i times that of the frequency; None at rest."""
    begin: float
    """Begin of the first block [s]."""
    end: float
    """End of the last block [s]."""
    thrust: float = 0.0
    """Thrust that is known without the factor [N]; then `power` is 0."""
    thrust_variance: float = 0.0
    """Variance of `thrust` [N²]."""

    def drift_variance(self, later: "Level", rate: float) -> float:
        """Return the variance of the change of the zero between two levels [N²].

        It is that of a random walk, or that of a steady drift where it is larger.
        rate: variance of the change after `DRIFT_LAG_S`, per second of it [N²/s]
        """
        widths = self.end - self.begin + later.end - later.begin
        gap = max(0.0, later.begin - self.end)
        return rate * max(gap + widths / 3.0, (gap + 0.5 * widths) ** 2 / DRIFT_LAG_S)


class Factor(NamedTuple):
    """Thrust over power, and its uncertainty."""

    value: float = 0.0
    """Thrust over the mean square of `fin_velocity` [N over the square of that quantity's unit]."""
    variance: float = math.inf
    """Variance of `value`; infinite while nothing is known."""
    time: float = 0.0
    """Time of the latest update [s]."""
    size: complex | None = None
    """Size of the wave that it holds for, as in `Level`."""
    wave: Wave | None = None
    """The wave that it holds for."""

    def at(self, time: float) -> "Factor":
        """Return the factor with its variance at a later time [s]."""
        passed = max(0.0, time - self.time)
        walked = self.variance + (FACTOR_WALK * self.value) ** 2 * passed
        return self._replace(variance=walked, time=max(time, self.time))

    def scatter(self, size: complex | None, wave: Wave | None = None) -> float:
        """Return the variance of the difference between this factor and that of another wave.

        size: its size; None where that is not known
        wave: None for the wave of this factor
        """
        if wave is not None and self.wave is not None and wave != self.wave:
            return (WAVE_SCATTER * self.value) ** 2
        if size is None or self.size is None:
            return 0.0
        return (SIZE_SCATTER * abs(size - self.size) * self.value) ** 2

    def after_step(self, before: Level, after: Level, drift: float, wave: Wave) -> "Factor":
        """Return the factor updated by the change of the force from one level to another.

        This is a step of a Kalman filter. Another wave has another factor, which differs by the
        variance `scatter`; another size of the wave is a less certain sample of the same factor,
        and the size that the factor holds for moves there by the fraction of the variance that it
        removes. Neither level's zero is estimated: only their difference enters, with the variance
        of its drift.

        drift: variance of the change of the zero after a second [N²/s]
        wave: the wave of `after`
        """
        power, step = after.power, after.power - before.power
        if not max(power, before.power) > 0.0:
            return self
        prior, change = self.at(after.end), after.force - before.force
        variance, known = prior.variance, math.isfinite(prior.variance)
        if not known:
            variance = (UNKNOWN_THRUST_SD_N / max(power, before.power)) ** 2
            if step:  # a first guess, for the scatter between the two sizes
                guess = (change + before.thrust) / step
                prior = prior._replace(value=guess, size=before.size)
        other = prior.scatter(after.size, wave) if power else 0.0
        value = prior.value if known else 0.0
        noise = before.variance + after.variance + before.thrust_variance
        noise += before.drift_variance(after, drift)
        moves = not known or (wave != self.wave if power else False)
        if not moves:  # the factor stays that of its size, which this level is a sample of
            noise += other * power**2
            other = 0.0
        surprise = change + before.thrust - value * step
        total = variance * step**2 + other * power**2 + noise
        limit = CONTRADICTION_SIGMAS * (2.0 if moves else 1.0)
        excess = max(0.0, surprise**2 - limit**2 * total)
        if excess:  # the zero has moved, or the factor is another: either is possible
            total += excess
            if power:
                other += excess / power**2
                total += excess
        common = variance * step + other * power
        gain = common / total
        left = max(0.0, variance + other - gain * common)
        size = after.size or self.size
        if not moves and not excess and size is not None and self.size is not None:
            size = self.size + (1.0 - left / variance) * (size - self.size)
        new_wave = wave if power else self.wave
        return Factor(value + gain * surprise, left, after.end, size, new_wave)


class Drift:
    """How fast the zero drifts: mean square of its change over some seconds, per second."""

    def __init__(self, prior_rate: float) -> None:
        """prior_rate: rate before the first comparison, as configured [N²/s]"""
        self._prior_rate = prior_rate
        self._sum = 0.0
        self._count = self._fresh = self._total = 0
        self._recent_rate = 0.0
        self._near_rate = 0.0

    def start(self) -> None:
        """Begin a swim or a rest: the drift before it counts as half of what is near the change."""
        self._count = min(self._total, NEAR_COMPARISONS)
        self._sum = self._recent_rate * self._count
        self._fresh, self._near_rate = 0, 0.0

    def add(self, change: float, lag: float, noise: float) -> None:
        """Take in a change of the force in a steady swim or rest.

        change: change of the force, that of the power allowed for [N]
        lag: time of that change, at most `DRIFT_LAG_S` [s]
        noise: variance of either force by noise [N²]
        """
        rate = (change**2 - NOISE_PART * noise) / lag
        if change**2 > CLEAR_DRIFT_SIGMAS**2 * 2.0 * noise:  # it may go on at this speed
            rate *= DRIFT_LAG_S / lag
        self._sum += rate
        self._count += 1
        self._fresh += 1
        self._total += 1
        self._recent_rate += (rate - self._recent_rate) / min(self._total, MEMORY_COMPARISONS)
        if self._fresh == NEAR_COMPARISONS:
            self._near_rate = self._sum / self._count

    @property
    def rate(self) -> float:
        """Variance of the change of the zero after a second [N²/s].

        The largest of what the comparisons have left of the configured one, of the means over the
        latest comparisons and since the swim or rest began, and of that near its begin: a drift
        that has ended since still counts for the change that began it.
        """
        mean = self._sum / self._count if self._count else 0.0
        prior = self._prior_rate * PRIOR_COMPARISONS / (PRIOR_COMPARISONS + self._total)
        return max(prior, self._recent_rate, mean, self._near_rate)
