"""The ratio of thrust to power is estimated only from changes of the force."""

import math
import random
from collections.abc import Iterator
from typing import NamedTuple

import pytest

from fishd.control.estimators.live_thrust import LiveThrust
from fishd.control.estimators.thrust_factor import DRIFT_LAG_S, NOISE_PART, Drift, Level
from fishd.core.signals import Observation

TICK = 0.3
"""Period of the loop [s]; a beat has two ticks."""
TRUE_FACTOR = 75.0
POWER = 3.4e-4
"""Mean square of the fin velocity, which gives a thrust of 25.5 mN."""


class Rig:
    """A fish with a noisy, drifting force sensor, which swims whole beats."""

    def __init__(
        self,
        seed: int,
        force_noise: float = 1e-3,
        power_noise: float = 0.03,
        walk: float = 6e-4,
        zero_drift: float = 6e-4,
    ) -> None:
        """Set up a sensor.

        force_noise: standard deviation of the force of a tick [N]
        power_noise: standard deviation of the measured power of a beat, as a fraction of it
        walk: standard deviation of the change of the zero after a second [N/√s]
        """
        self.random = random.Random(seed)
        self.live = LiveThrust(zero_drift)
        self.zero = self.time = 0.0
        self.force_noise, self.power_noise, self.walk = force_noise, power_noise, walk
        self.wave = ("swing", {"C": 0.6})

    def _tick(self, angle: float, thrust: float, velocity: float) -> None:
        self.time += TICK
        self.zero += self.random.gauss(0.0, self.walk * math.sqrt(TICK))
        fx = self.zero + thrust + self.random.gauss(0.0, self.force_noise)
        rate = 1.0 / (2 * TICK)
        seen = Observation(self.time, TICK, fx, 0.0, 0.0, velocity, angle, angle, fx, rate)
        self.live.update(seen, angle != 0.0, self.wave)

    def rest(self, seconds: float = 3.0) -> None:
        for _ in range(round(seconds / TICK)):
            self._tick(0.0, 0.0, 0.0)

    def beats(self, count: int, power: float = POWER) -> None:
        """Swim `count` beats; the power of each is measured with an error."""
        for _ in range(count):
            measured = power * max(0.1, self.random.gauss(1.0, self.power_noise))
            velocity = math.sqrt(measured)
            for angle in (0.4, -0.4):
                self._tick(angle, TRUE_FACTOR * power, velocity)


class FactorError(NamedTuple):
    """The error of the factor and the half-width of its interval, as fractions of the truth."""

    error: float
    ci95: float


def factor_error(rig: Rig) -> FactorError:
    value, ci95 = rig.live.factor
    return FactorError(value / TRUE_FACTOR - 1.0, ci95 / TRUE_FACTOR)


def test_a_steady_swim_of_5_000_beats_changes_no_factor() -> None:
    rig = Rig(0)
    rig.rest()
    rig.beats(20)
    before = factor_error(rig)
    rig.beats(5_000)
    after = factor_error(rig)
    assert after.error == pytest.approx(before.error, abs=1e-5)
    assert abs(after.error) < after.ci95
    assert after.ci95 > before.ci95


def ci95_with_pattern(pattern: float) -> float:
    """Return the half-width after a swim on a zero that drifts by 0.6 mN/s.

    pattern: by which the force of each second beat is larger [N]
    """
    rig = Rig(0, force_noise=1e-4, power_noise=0.0, walk=0.0)
    rig.rest()
    for beat in range(40):
        rig.zero += 0.36e-3 + (pattern if beat % 2 else -pattern)
        rig.beats(1)
    return factor_error(rig).ci95


def test_a_pattern_of_the_beats_hides_no_drift() -> None:
    assert ci95_with_pattern(2e-3) > 0.8 * ci95_with_pattern(0.0) > 0.05


def random_swims(rig: Rig, beats: int) -> Iterator[FactorError]:
    """Rest and swim waves of several sizes at random; yield the error after each."""
    swum = 0
    while swum < beats:
        if rig.random.random() < 0.4:
            rig.rest(rig.random.uniform(2.5, 8.0))
        power = POWER * math.exp(rig.random.uniform(-2.0, 0.3))
        count = rig.random.randint(8, 120)
        rig.beats(count, power)
        swum += count
        if rig.live.factor:
            yield factor_error(rig)


@pytest.mark.slow
def test_the_factor_is_unbiased_over_20_000_beats_whatever_the_noise_and_the_drift() -> None:
    errors = []
    for seed in range(20):
        chance = random.Random(seed)
        rig = Rig(
            seed,
            force_noise=chance.choice((0.0, 1e-3, 5e-3)),
            power_noise=chance.choice((0.0, 0.02, 0.1)),
            walk=chance.choice((0.0, 6e-4, 3e-3)),
        )
        errors += random_swims(rig, 1_000)
    weights = [error.ci95**-2 for error in errors]
    weighted = zip(errors, weights, strict=True)
    mean = sum(error.error * weight for error, weight in weighted) / sum(weights)
    assert abs(mean) < 0.01
    assert sum(abs(error.error) < error.ci95 for error in errors) > 0.9 * len(errors)
    assert all(abs(error.error) < 3.0 * error.ci95 for error in errors)


@pytest.mark.parametrize(("sigmas", "lasts"), [(1.9, 0.5), (2.1, DRIFT_LAG_S)])
def test_only_a_change_that_is_clear_of_the_noise_counts_as_a_drift_that_goes_on(
    sigmas: float, lasts: float
) -> None:
    drift, noise, lag = Drift(0.0), 1e-6, 0.5
    change = sigmas * math.sqrt(2.0 * noise)
    drift.add(change, lag, noise)
    assert drift.rate == pytest.approx((change**2 - NOISE_PART * noise) * lasts / lag**2)


def test_a_sensor_that_does_not_drift_is_believed_after_some_comparisons() -> None:
    drift = Drift(1e-6)
    rates = []
    for _ in range(100):
        rates.append(drift.rate)
        drift.add(0.0, DRIFT_LAG_S, 0.0)
    assert rates[0] == 1e-6
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < 0.15e-6


def test_a_drift_that_goes_on_moves_the_zero_in_proportion_to_the_time() -> None:
    rest = Level(force=0.0, variance=0.0, power=0.0, size=None, begin=0.0, end=2.0)
    swim = rest._replace(begin=4.0, end=8.0)
    slope = 0.4e-3
    rate = (slope * DRIFT_LAG_S) ** 2 / DRIFT_LAG_S
    assert math.sqrt(rest.drift_variance(swim, rate)) == pytest.approx(slope * 5.0)
