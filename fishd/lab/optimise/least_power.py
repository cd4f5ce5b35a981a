"""The parameters that give a thrust at the least power: two quantities, each with its own error.

A Gaussian process stands for the thrust and another for the logarithm of the power. What is
measured next is where the improvement of the power, times the probability that the thrust is
reached, is expected to be largest (Gardner et al., Bayesian Optimization with Inequality
Constraints, ICML 2014); until it is reached somewhere, where that is most probable.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import norm

from fishd.lab.optimise.search import Array, Proposal, Range, Search
from fishd.lab.statistics import Z95

CURVES = 400
"""How many pairs of curves the interval of the best is found from."""


class LeastPower:
    """What was measured, what to measure next, and what seems best; as `Search`."""

    def __init__(self, ranges: Sequence[Range], target: float, seed: int = 0) -> None:
        """target: the thrust to reach [N]; raises `ParameterError` as `Search` does"""
        self.target = target
        self._seed = seed
        self._thrust, self._power = Search(ranges, seed), Search(ranges, seed)
        self.ranges = self._thrust.ranges

    @property
    def trials(self) -> int:
        """How many candidates were measured."""
        return self._thrust.trials

    @property
    def is_warm(self) -> bool:
        """Is there enough to judge an expected improvement?"""
        return self._thrust.is_warm

    def observe(
        self,
        parameters: Mapping[str, float],
        thrust: tuple[float, float],
        power: tuple[float, float],
    ) -> None:
        """Take what a candidate gave [N] and took [W], each with half of its 95 % interval."""
        self._thrust.observe(parameters, *thrust)
        watts, error = power
        self._power.observe(parameters, math.log(watts), error / watts)

    def suggest(self) -> dict[str, float]:
        """The next candidate: first some that fill the ranges, then what promises most."""
        if not self._thrust.is_filled:
            return self._thrust.suggest()
        places = self._thrust.places()
        gain, _ = self._gain(places)
        return self._thrust.parameters_at(places[int(np.argmax(gain))])

    def proposal(self) -> Proposal:
        """The least power among what reaches the thrust; the most thrust where nothing does."""
        places = self._thrust.places()
        thrust, thrust_covariance = self._thrust.expectation(places)
        power, power_covariance = self._power.expectation(places)
        gain, reached = self._gain(places)
        if not (thrust >= self.target).any():
            found = self._thrust.proposal()
            return found._replace(improvement=max(found.improvement, math.exp(gain.max())))
        best = int(np.argmin(np.where(thrust >= self.target, power, np.inf)))
        generator = np.random.default_rng(self._seed)
        draws = [
            generator.multivariate_normal(mean, covariance, CURVES, "ignore", method="eigh")
            for mean, covariance in ((thrust, thrust_covariance), (power, power_covariance))
        ]
        reaching = draws[0] >= self.target
        least = np.where(reaching, draws[1], np.inf).argmin(axis=1)[reaching.any(axis=1)]
        tops = places[least] if least.size else places[[best]]
        low = np.minimum(np.quantile(tops, 0.025, axis=0, method="lower"), places[best])
        high = np.maximum(np.quantile(tops, 0.975, axis=0, method="higher"), places[best])
        watts = math.exp(power[best])
        return Proposal(
            self._thrust.parameters_at(places[best]),
            self._thrust.parameters_at(low),
            self._thrust.parameters_at(high),
            watts,
            Z95 * watts * math.sqrt(max(float(power_covariance[best, best]), 0.0)),
            float(gain.max()) if reached else 1.0,
        )

    def alike(self, observed: Iterable[tuple[Mapping[str, float], float, float]]) -> Search:
        """As of `Search`."""
        return self._thrust.alike(observed)

    def _gain(self, places: Array) -> tuple[Array, bool]:
        """The share of power that is expected to be saved there, and True.

        While the thrust is not expected to be reached at any place that was measured: the
        logarithm of the probability that it is there, and False.
        """
        tried = self._thrust.tried
        both: Array = np.vstack((places, tried))
        thrust, thrust_covariance = self._thrust.expectation(both)
        power, power_covariance = self._power.expectation(both)
        reaching = power[-len(tried) :][thrust[-len(tried) :] >= self.target]
        n = len(places)
        deviation, power_deviation = (
            np.sqrt(np.maximum(np.diag(each)[:n], 1e-18))
            for each in (thrust_covariance, power_covariance)
        )
        margin = (thrust[:n] - self.target) / deviation
        if not reaching.size:
            return np.asarray(norm.logcdf(margin)), False
        saved = reaching.min() - power[:n]
        score = saved / power_deviation
        gain = saved * norm.cdf(score) + power_deviation * norm.pdf(score)
        return np.asarray(gain * norm.cdf(margin)), True
