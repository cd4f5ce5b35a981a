"""Where to measure next, and what seems best: Bayesian optimisation of noisy measurements.

A Gaussian process stands for the objective over the parameters, a thrust unless another is said
(`fishd.lab.objective`); each measurement comes with its own
error. What is measured next is where the expected improvement is largest (Jones et al., J. Glob.
Optim. 13 (1998) 455), over the best that the process expects at what was measured, since that is
noisy (Huang et al., J. Glob. Optim. 34 (2006) 441).
"""

import contextlib
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from bayes_opt import BayesianOptimization
from bayes_opt.acquisition import AcquisitionFunction, ExpectedImprovement
from numpy.typing import NDArray
from scipy.stats import qmc
from sklearn.gaussian_process.kernels import ConstantKernel, Matern

from fishd.core.errors import ParameterError
from fishd.lab.statistics import Z95

Array = NDArray[np.float64]

LOGARITHMIC = 4.0
"""A range of positive numbers is searched by ratio where its ends differ by more than this."""
FEWEST = 4
"""The search does not end before so many candidates, and 2 more for each further parameter."""
LENGTH = 0.3
"""How far the thrust at one place says something of that at another, as a share of the range."""
LEARNT = 8
"""Trials from which on that length is found from what was measured; 4 more for each parameter."""
_SAMPLES, _GRID = 400, 400


class Range(NamedTuple):
    """A parameter that is searched, and between what."""

    name: str
    low: float
    high: float
    values: tuple[float, ...] = ()
    """Those that it can have, from low to high; empty where it can have any."""

    def value(self, share: float) -> float:
        """What a number from 0 to 1 stands for: the nearest that it can have."""
        if self.values:
            return min(self.values, key=lambda each: abs(self.share(each) - share))
        return self.between(share)

    def between(self, share: float) -> float:
        """What that number stands for where any value is possible."""
        if self.is_logarithmic:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + share * (self.high - self.low))

    def share(self, value: float) -> float:
        """The number from 0 to 1 that stands for a value."""
        if self.is_logarithmic:
            found = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            found = (value - self.low) / (self.high - self.low)
        return min(1.0, max(0.0, found))

    def check(self) -> None:
        """Raises `ParameterError` where it is empty."""
        if not self.low < self.high or not math.isfinite(self.high - self.low):
            raise ParameterError(f"{self.name}: from {self.low:g} to {self.high:g} is no range")

    @property
    def is_logarithmic(self) -> bool:
        """By ratio rather than by difference?"""
        return self.low > 0.0 and self.high > LOGARITHMIC * self.low


class Proposal(NamedTuple):
    """Where the Gaussian process expects the most, among what can be measured."""

    parameters: dict[str, float]
    low: dict[str, float]
    """Of each parameter, the 95 % interval of where the maximum lies: it lies between these in 95 %
    of the curves that agree with what was measured."""
    high: dict[str, float]
    value: float
    """Of the objective; [N] where that is the thrust."""
    error: float
    """Half of its 95 % interval."""
    improvement: float
    """Largest expected improvement by another trial, as a share of `value`."""


class Search:
    """What was measured, what to measure next, and what seems best."""

    def __init__(self, ranges: Sequence[Range], seed: int = 0) -> None:
        """Raises `ParameterError` for an empty range, or none."""
        if not ranges:
            raise ParameterError("nothing to search: name a parameter")
        for each in ranges:
            each.check()
        self.ranges = tuple(ranges)
        self._seed = seed
        self._names = [each.name for each in ranges]
        self._acquisition = _NoisyImprovement(xi=0.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._library = BayesianOptimization(
                f=None,
                pbounds=dict.fromkeys(self._names, (0.0, 1.0)),
                acquisition_function=self._acquisition,
                random_state=seed,
                verbose=0,
                allow_duplicate_points=True,
            )
        first = 2 * len(ranges) + 1
        self._first = qmc.LatinHypercube(len(ranges), scramble=False, rng=seed).random(first)
        self._possible = self._fill()
        self._variances: list[float] = []

    def alike(self, observed: Iterable[tuple[Mapping[str, float], float, float]]) -> "Search":
        """Another one over the same ranges, that knows of these values and errors instead."""
        other = Search(self.ranges, self._seed)
        for each in observed:
            other.observe(*each)
        return other

    @property
    def trials(self) -> int:
        """How many candidates were measured."""
        return len(self._variances)

    @property
    def is_filled(self) -> bool:
        """Were those measured that fill the ranges?"""
        return self.trials >= len(self._first)

    @property
    def tried(self) -> Array:
        """Where it was measured, as numbers from 0 to 1; (trials, parameters)."""
        return np.array(self._library.space.params)

    def places(self) -> Array:
        """What can be measured, or fills it, and what was, as such numbers; (n, parameters)."""
        return np.vstack((self._possible, self.tried))

    @property
    def is_warm(self) -> bool:
        """Is there enough to judge an expected improvement?"""
        return self.trials >= FEWEST + 2 * (len(self.ranges) - 1)

    def suggest(self) -> dict[str, float]:
        """The next candidate: first some that fill the ranges, then what promises most."""
        if not self.is_filled:
            return self.parameters_at(self._untried(self._first[self.trials]))
        if any(each.values for each in self.ranges):
            gain, _ = self._gain(self._possible)
            return self.parameters_at(self._possible[int(np.argmax(gain))])
        self._fit_noise()
        found = self._library.suggest()
        return self.parameters_at(np.array([found[name] for name in self._names]))

    def observe(self, parameters: Mapping[str, float], value: float, error: float) -> None:
        """Take what a candidate gave, and half of its 95 % interval."""
        share = {each.name: each.share(parameters[each.name]) for each in self.ranges}
        self._variances.append(max(error / Z95, 1e-3 * abs(value), 1e-9) ** 2)
        with contextlib.redirect_stdout(None):  # where it prints that a candidate came again
            self._library.register(params=share, target=value)

    def proposal(self) -> Proposal:
        """What seems best now; there must have been a trial."""
        shares: Array = np.vstack((self._possible, self._library.space.params))
        gain, (mean, covariance) = self._gain(shares)
        best = int(np.argmax(mean))
        generator = np.random.default_rng(self._seed)
        curves = generator.multivariate_normal(
            mean, covariance, _SAMPLES, method="eigh", check_valid="ignore"
        )
        tops = shares[np.argmax(curves, axis=1)]
        low = np.quantile(tops, 0.025, axis=0, method="lower")
        high = np.quantile(tops, 0.975, axis=0, method="higher")
        return Proposal(
            self.parameters_at(shares[best]),
            self.parameters_at(np.minimum(low, shares[best])),
            self.parameters_at(np.maximum(high, shares[best])),
            float(mean[best]),
            Z95 * math.sqrt(max(float(covariance[best, best]), 1e-18)),
            float(gain.max() / abs(mean[best])),
        )

    def expected(self, parameters: Mapping[str, float]) -> tuple[float, float]:
        """What is expected there, and half of its 95 % interval; there must have been a trial."""
        place: Array = np.array([[each.share(parameters[each.name]) for each in self.ranges]])
        mean, covariance = self.expectation(place)
        return float(mean[0]), Z95 * math.sqrt(max(float(covariance[0, 0]), 0.0))

    def measured(self, name: str) -> tuple[list[float], list[float], list[float]]:
        """The values of a parameter that were tried, and their thrusts and errors [N]."""
        index = self._names.index(name)
        shares = self._library.space.params[:, index]
        values = [self.ranges[index].value(float(share)) for share in shares]
        thrusts = [float(target) for target in self._library.space.target]
        return values, thrusts, [Z95 * math.sqrt(each) for each in self._variances]

    def curve(self, points: int = 200) -> tuple[Array, Array, Array]:
        """Of one parameter: its values, the thrust, and half of its 95 % interval [N]."""
        shares = np.linspace(0.0, 1.0, points)
        mean, covariance = self.expectation(shares[:, None])
        values = np.array([self.ranges[0].between(float(share)) for share in shares])
        return values, mean, Z95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))

    def expectation(self, shares: Array) -> tuple[Array, Array]:
        """What is expected at such places, (n,), and its covariance, (n, n)."""
        self._fit_noise()
        places = [dict(zip(self._names, map(float, place), strict=True)) for place in shares]
        return cast(tuple[Array, Array], self._library.predict(places, return_cov=True))

    def _gain(self, shares: Array) -> tuple[Array, tuple[Array, Array]]:
        """The improvement expected at these places [N]; the thrust there, and its covariance."""
        places: Array = np.vstack((shares, self._library.space.params))
        mean, covariance = self.expectation(places)
        deviation: Array = np.sqrt(np.maximum(np.diag(covariance), 1e-18))
        self._acquisition.y_max = mean[-self.trials :].max()
        n = len(shares)
        gain = cast(Array, self._acquisition.base_acq(mean[:n], deviation[:n]))
        return gain, (mean[:n], covariance[:n, :n])

    @property
    def _is_finite(self) -> bool:
        """Is there a single parameter, of few values?"""
        return len(self.ranges) == 1 and bool(self.ranges[0].values)

    def _fill(self) -> Array:
        """Numbers from 0 to 1 that fill the space, all of them possible; (n, parameters)."""
        if self._is_finite:
            only = self.ranges[0]
            return np.array([[only.share(value)] for value in only.values])
        filling = np.linspace(0.0, 1.0, _GRID)[:, None]
        if len(self.ranges) > 1:
            within = qmc.Halton(len(self.ranges), rng=self._seed).random(2 * _GRID)
            filling = np.clip(1.05 * within - 0.025, 0.0, 1.0)  # with the edges
        for index, each in enumerate(self.ranges):
            if each.values:
                filling[:, index] = [each.share(each.value(share)) for share in filling[:, index]]
        return filling

    def _untried(self, share: Array) -> Array:
        """The nearest that is possible, and new where there are few."""
        if not self._is_finite:
            return share
        tried = self._library.space.params[:, 0] if self.trials else np.empty(0)
        new = [each for each in self._possible if not np.any(np.isclose(tried, each[0]))]
        return min(new or self._possible, key=lambda each: abs(float(each[0] - share[0])))

    def parameters_at(self, shares: Array) -> dict[str, float]:
        """What a place stands for."""
        return {
            each.name: each.value(float(share))
            for each, share in zip(self.ranges, shares, strict=True)
        }

    def _fit_noise(self) -> None:
        """Tell the process how far each measurement is to be believed."""
        scale = float(np.std(self._library.space.target)) or 1.0  # it normalises by that
        learns = self.trials >= LEARNT + 4 * (len(self.ranges) - 1)
        size = ConstantKernel(1.0, (0.3, 10.0) if learns else "fixed")
        bounds = (LENGTH / 2.0, LENGTH * 4.0) if learns else "fixed"
        self._library.set_gp_params(
            alpha=np.array(self._variances) / scale**2,
            kernel=size * Matern([LENGTH] * len(self.ranges), bounds, nu=2.5),
        )


class _NoisyImprovement(ExpectedImprovement):
    """Over the best that the process expects at what was measured, not over the luckiest value."""

    def suggest(
        self,
        gp: Any,
        target_space: Any,
        n_random: int = 10_000,
        n_smart: int = 10,
        fit_gp: bool = True,
        random_state: Any = None,
    ) -> Any:
        """As the library's, which calls it."""
        self._fit_gp(gp=gp, target_space=target_space)
        self.y_max = gp.predict(target_space.params).max()
        return AcquisitionFunction.suggest(
            self, gp, target_space, n_random, n_smart, fit_gp=False, random_state=random_state
        )
