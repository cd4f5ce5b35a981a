"""Search of the parameters that give a thrust at the least power, by constrained optimisation.

One Gaussian process models the thrust, another the logarithm of the power. The next candidate
maximises the expected improvement of the power times the probability that the thrust is reached
(Gardner et al., Bayesian Optimization with Inequality Constraints, ICML 2014). Until a measured
candidate reaches the thrust, the next one maximises that probability alone.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.stats import norm

from fishd.lab.optimise.search import Array, Proposal, Range, Search
from fishd.lab.statistics import Z95

SAMPLE_COUNT = 400
"""Number of pairs of sampled curves from which the interval of the best is computed."""


class LeastPower:
    """Search of a thrust at the least power; its interface is that of `Search`."""

    def __init__(self, ranges: Sequence[Range], target: float, seed: int = 0) -> None:
        """target: thrust to reach [N]; raises `ParameterError` as `Search` does"""
        self.target = target
        self._seed = seed
        self._thrust, self._power = Search(ranges, seed), Search(ranges, seed)
        self.ranges = self._thrust.ranges

    @property
    def trials(self) -> int:
        """Number of measured candidates."""
        return self._thrust.trials

    @property
    def is_filled(self) -> bool:
        """Whether the candidates that fill the ranges were measured."""
        return self._thrust.is_filled

    @property
    def is_warm(self) -> bool:
        """Whether enough was measured to judge an expected improvement."""
        return self._thrust.is_warm

    def observe(
        self,
        parameters: Mapping[str, float],
        thrust: tuple[float, float],
        power: tuple[float, float],
    ) -> None:
        """Add the thrust [N] and the power [W] of a candidate, each with its half-width (95 %)."""
        self._thrust.observe(parameters, *thrust)
        watts, error = power
        self._power.observe(parameters, math.log(watts), error / watts)

    def suggest(self) -> dict[str, float]:
        """Return the next candidate: first points that fill the ranges, then the most promising."""
        if not self._thrust.is_filled:
            return self._thrust.suggest()
        places = self._thrust.all_shares()
        gain, _ = self._expected_gain(places)
        return self._thrust.parameters_at(places[int(np.argmax(gain))])

    def propose(self) -> Proposal:
        """Return the place of least power that reaches the thrust; else that of the most thrust."""
        places = self._thrust.all_shares()
        thrust, thrust_covariance = self._thrust.predict_shares(places)
        power, power_covariance = self._power.predict_shares(places)
        gain, reached = self._expected_gain(places)
        if not (thrust >= self.target).any():
            most_thrust = self._thrust.propose()
            return most_thrust._replace(
                improvement=max(most_thrust.improvement, math.exp(gain.max()))
            )
        best = int(np.argmin(np.where(thrust >= self.target, power, np.inf)))
        generator = np.random.default_rng(self._seed)
        draws = [
            generator.multivariate_normal(mean, covariance, SAMPLE_COUNT, "ignore", method="eigh")
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

    def with_observations(
        self, observed: Iterable[tuple[Mapping[str, float], float, float]]
    ) -> Search:
        """Return a search of one quantity, as `Search.with_observations` does."""
        return self._thrust.with_observations(observed)

    def _expected_gain(self, places: Array) -> tuple[Array, bool]:
        """Return the fraction of power that each place is expected to save, and True.

        If no measured place is expected to reach the thrust, return the logarithm of the
        probability that each place reaches it, and False.
        """
        tried = self._thrust.tried
        all_places: Array = np.vstack((places, tried))
        thrust, thrust_covariance = self._thrust.predict_shares(all_places)
        power, power_covariance = self._power.predict_shares(all_places)
        reaching = power[-len(tried) :][thrust[-len(tried) :] >= self.target]
        n = len(places)
        deviation, power_deviation = (
            np.sqrt(np.maximum(np.diag(covariance)[:n], 1e-18))
            for covariance in (thrust_covariance, power_covariance)
        )
        margin = (thrust[:n] - self.target) / deviation
        if not reaching.size:
            return np.asarray(norm.logcdf(margin)), False
        saved = reaching.min() - power[:n]
        score = saved / power_deviation
        gain = saved * norm.cdf(score) + power_deviation * norm.pdf(score)
        return np.asarray(gain * norm.cdf(margin)), True
