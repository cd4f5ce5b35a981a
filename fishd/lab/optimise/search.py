"""Where to measure next, and what seems best: Bayesian optimisation of noisy measurements.

A Gaussian process stands for the thrust over the parameters; each measurement comes with its own
error. What is measured next is where the expected improvement is largest (Jones et al., J. Glob.
Optim. 13 (1998) 455), over the best that the process expects at what was measured, since that is
noisy (Huang et al., J. Glob. Optim. 34 (2006) 441).
"""

import contextlib
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from bayes_opt import BayesianOptimization
from bayes_opt.acquisition import AcquisitionFunction, ExpectedImprovement
from numpy.typing import NDArray
from scipy.stats import qmc
from sklearn.gaussian_process.kernels import ConstantKernel, Matern

from fishd.core.errors import ParameterError

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

    def value(self, share: float) -> float:
        """What a number from 0 to 1 stands for."""
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

    @property
    def is_logarithmic(self) -> bool:
        """By ratio rather than by difference?"""
        return self.low > 0.0 and self.high > LOGARITHMIC * self.low


class Proposal(NamedTuple):
    """Where the Gaussian process expects the most thrust."""

    parameters: dict[str, float]
    low: dict[str, float]
    """Of each parameter, the 95 % interval of where the maximum lies: it would there in as many of
    the curves that go with what was measured."""
    high: dict[str, float]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    improvement: float
    """Largest expected improvement by another trial, as a share of `thrust`."""


class Search:
    """What was measured, what to measure next, and what seems best."""

    def __init__(self, ranges: Sequence[Range], seed: int = 0) -> None:
        """Raises `ParameterError` for an empty range, or none."""
        if not ranges:
            raise ParameterError("nothing to search: name a parameter")
        for each in ranges:
            if not each.low < each.high or not math.isfinite(each.high - each.low):
                raise ParameterError(f"{each.name}: from {each.low:g} to {each.high:g} is no range")
        self.ranges = tuple(ranges)
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
        spread = qmc.LatinHypercube(len(ranges), scramble=False, rng=seed).random(first)
        self._first = iter(spread)
        self._variances: list[float] = []
        self._seed = seed

    @property
    def trials(self) -> int:
        """How many candidates were measured."""
        return len(self._variances)

    @property
    def is_warm(self) -> bool:
        """Is there enough to judge an expected improvement?"""
        return self.trials >= FEWEST + 2 * (len(self.ranges) - 1)

    def suggest(self) -> dict[str, float]:
        """The next candidate: first some that fill the ranges, then what promises most."""
        share = next(self._first, None)
        if share is None:
            self._fit_noise()
            found = self._library.suggest()
            share = np.array([found[name] for name in self._names])
        return self._parameters(share)

    def observe(self, parameters: Mapping[str, float], thrust: float, error: float) -> None:
        """Take what a candidate gave [N], and half of its 95 % interval [N]."""
        share = {each.name: each.share(parameters[each.name]) for each in self.ranges}
        self._variances.append(max(error / 1.96, 1e-3 * abs(thrust), 1e-9) ** 2)
        with contextlib.redirect_stdout(None):  # where it prints that a candidate came again
            self._library.register(params=share, target=thrust)

    def proposal(self) -> Proposal:
        """What seems best now; there must have been a trial."""
        shares = self._candidates()
        mean, covariance = self._expected(shares)
        best = int(np.argmax(mean))
        generator = np.random.default_rng(self._seed)
        curves = generator.multivariate_normal(
            mean, covariance, _SAMPLES, method="eigh", check_valid="ignore"
        )
        low, high = np.quantile(shares[np.argmax(curves, axis=1)], (0.025, 0.975), axis=0)
        deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-18))
        self._acquisition.y_max = mean[-self.trials :].max()
        gain = self._acquisition.base_acq(mean, deviation)
        return Proposal(
            self._parameters(shares[best]),
            self._parameters(np.minimum(low, shares[best])),
            self._parameters(np.maximum(high, shares[best])),
            float(mean[best]),
            1.96 * float(deviation[best]),
            float(gain.max() / abs(mean[best])),
        )

    def measured(self, name: str) -> tuple[list[float], list[float], list[float]]:
        """The values of a parameter that were tried, and their thrusts and errors [N]."""
        index = self._names.index(name)
        shares = self._library.space.params[:, index]
        values = [self.ranges[index].value(float(share)) for share in shares]
        thrusts = [float(target) for target in self._library.space.target]
        return values, thrusts, [1.96 * math.sqrt(each) for each in self._variances]

    def curve(self, points: int = 200) -> tuple[Array, Array, Array]:
        """Of one parameter: its values, the thrust, and half of its 95 % interval [N]."""
        shares = np.linspace(0.0, 1.0, points)
        mean, covariance = self._expected(shares[:, None])
        values = np.array([self.ranges[0].value(share) for share in shares])
        return values, mean, 1.96 * np.sqrt(np.maximum(np.diag(covariance), 0.0))

    def _expected(self, shares: Array) -> tuple[Array, Array]:
        """The thrust at these places, and its covariance."""
        self._fit_noise()
        places = [dict(zip(self._names, map(float, place), strict=True)) for place in shares]
        return cast(tuple[Array, Array], self._library.predict(places, return_cov=True))

    def _candidates(self) -> Array:
        """Numbers from 0 to 1 that fill the space, and what was measured; (n, parameters)."""
        filling = np.linspace(0.0, 1.0, _GRID)[:, None]
        if len(self.ranges) > 1:
            filling = qmc.Halton(len(self.ranges), rng=self._seed).random(2 * _GRID)
        return np.vstack((filling, self._library.space.params))

    def _parameters(self, shares: Array) -> dict[str, float]:
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
