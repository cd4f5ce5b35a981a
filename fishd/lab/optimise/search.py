"""Bayesian optimisation of noisy measurements: the next candidate, and the best parameters.

A Gaussian process models the objective as a function of the parameters (`fishd.lab.optimise.trials`
names the objectives; the default is the thrust). Each measurement has its own error. The next
candidate is the place of the largest expected improvement (Jones et al., J. Glob. Optim. 13 (1998)
455). As measurements are noisy, the improvement is over the best predicted mean of the measured
places (Huang et al., J. Glob. Optim. 34 (2006) 441).
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

LOGARITHMIC_RATIO = 4.0
"""Ratio of the ends of a range of positive numbers above which it is searched by ratio."""
MIN_CANDIDATES = 4
"""Smallest number of candidates of a search, for one parameter; each further one adds 2."""
LENGTH_SCALE = 0.3
"""Correlation length of the thrust before it is fitted, as a fraction of the range."""
MIN_AMPLITUDE = 0.3
"""Smallest standard deviation of the objective over the range before it is measured, as a fraction
of its mean: a few measurements that are equal by chance must not pass for a flat curve."""
LENGTH_SCALE_FIT_TRIALS = 8
"""Number of trials from which on it is fitted, for one parameter; each further one adds 4."""
_SAMPLE_COUNT, _GRID_POINTS = 400, 400


class Range(NamedTuple):
    """Range of a searched parameter."""

    name: str
    low: float
    high: float
    values: tuple[float, ...] = ()
    """Possible values in ascending order; empty if all values are possible."""

    def value(self, share: float) -> float:
        """Return the possible value nearest to a share of the range, 0 to 1."""
        if self.values:
            return min(self.values, key=lambda value: abs(self.share(value) - share))
        return self.interpolate(share)

    def interpolate(self, share: float) -> float:
        """Return the value at a share of the range, 0 to 1, without regard to `values`."""
        if self.is_logarithmic:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + share * (self.high - self.low))

    def share(self, value: float) -> float:
        """Return the share of the range, 0 to 1, at which a value lies."""
        if self.is_logarithmic:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return min(1.0, max(0.0, share))

    def check(self) -> None:
        """Raise `ParameterError` if the range is empty."""
        if not self.low < self.high or not math.isfinite(self.high - self.low):
            raise ParameterError(
                f"{self.name}: from {self.low:g} to {self.high:g} is not a range: the lower end "
                "comes first"
            )

    @property
    def is_logarithmic(self) -> bool:
        """Whether the range is searched by ratio rather than by difference."""
        return self.low > 0.0 and self.high > LOGARITHMIC_RATIO * self.low


class Proposal(NamedTuple):
    """Possible candidate for which the Gaussian process predicts the largest objective."""

    parameters: dict[str, float]
    parameters_ci95_low: dict[str, float]
    """Lower end of the 95 % interval of each parameter at the maximum.

    The maximum lies in the interval in 95 % of the curves that agree with the measurements.
    """
    parameters_ci95_high: dict[str, float]
    """Upper end of that interval."""
    value: float
    """Predicted objective; [N] for the thrust."""
    value_ci95: float
    """Half-width of the 95 % interval of `value`."""
    improvement: float
    """Largest expected improvement by another trial, as a fraction of `value`."""


class Search:
    """Search of the parameters that maximise an objective."""

    def __init__(self, ranges: Sequence[Range], seed: int = 0) -> None:
        """Raises `ParameterError` for an empty range, or without ranges."""
        if not ranges:
            raise ParameterError("nothing to search: name a parameter")
        for searched in ranges:
            searched.check()
        self.ranges = tuple(ranges)
        self._seed = seed
        self._names = [searched.name for searched in ranges]
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
        initial_count = 2 * len(ranges) + 1
        self._first = qmc.LatinHypercube(len(ranges), scramble=False, rng=seed).random(
            initial_count
        )
        self._possible = self._fill_ranges()
        self._variances: list[float] = []

    def with_observations(
        self, observed: Iterable[tuple[Mapping[str, float], float, float]]
    ) -> "Search":
        """Return a new search over the same ranges, with these values and errors instead."""
        search = Search(self.ranges, self._seed)
        for observation in observed:
            search.observe(*observation)
        return search

    @property
    def trials(self) -> int:
        """Number of measured candidates."""
        return len(self._variances)

    @property
    def is_filled(self) -> bool:
        """Whether the candidates that fill the ranges were measured."""
        return self.trials >= len(self._first)

    @property
    def tried(self) -> Array:
        """Measured places, as shares of the ranges; shape (trials, parameters)."""
        return np.array(self._library.space.params)

    def all_shares(self) -> Array:
        """Return the possible and the measured places, as shares; shape (n, parameters)."""
        return np.vstack((self._possible, self.tried))

    @property
    def is_warm(self) -> bool:
        """Whether enough was measured to judge an expected improvement."""
        return self.trials >= MIN_CANDIDATES + 2 * (len(self.ranges) - 1)

    def suggest(self) -> dict[str, float]:
        """Return the next candidate: first points that fill the ranges, then the most promising."""
        if not self.is_filled:
            return self.parameters_at(self._find_untried(self._first[self.trials]))
        if any(searched.values for searched in self.ranges):
            gain, _ = self._expected_gain(self._possible)
            return self.parameters_at(self._possible[int(np.argmax(gain))])
        self._fit_noise()
        shares = self._library.suggest()
        return self.parameters_at(np.array([shares[name] for name in self._names]))

    def observe(self, parameters: Mapping[str, float], value: float, value_ci95: float) -> None:
        """Add the objective of a candidate, with the half-width of its 95 % interval."""
        shares = {
            searched.name: searched.share(parameters[searched.name]) for searched in self.ranges
        }
        self._variances.append(max(value_ci95 / Z95, 1e-3 * abs(value), 1e-9) ** 2)
        with contextlib.redirect_stdout(None):  # the library prints a line for a repeated candidate
            self._library.register(params=shares, target=value)

    def propose(self) -> Proposal:
        """Return the best candidate by the present model; at least one trial is needed."""
        shares: Array = np.vstack((self._possible, self._library.space.params))
        gain, (mean, covariance) = self._expected_gain(shares)
        best = int(np.argmax(mean))
        generator = np.random.default_rng(self._seed)
        curves = generator.multivariate_normal(
            mean, covariance, _SAMPLE_COUNT, method="eigh", check_valid="ignore"
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

    def predict(self, parameters: Mapping[str, float]) -> tuple[float, float]:
        """Return the prediction and the half-width of its 95 % interval; needs a trial."""
        place: Array = np.array(
            [[searched.share(parameters[searched.name]) for searched in self.ranges]]
        )
        mean, covariance = self.predict_shares(place)
        return float(mean[0]), Z95 * math.sqrt(max(float(covariance[0, 0]), 0.0))

    def read_measurements(self, name: str) -> tuple[list[float], list[float], list[float]]:
        """Return the measured values of a parameter, and their thrusts and errors [N]."""
        index = self._names.index(name)
        shares = self._library.space.params[:, index]
        values = [self.ranges[index].value(float(share)) for share in shares]
        thrusts = [float(target) for target in self._library.space.target]
        return values, thrusts, [Z95 * math.sqrt(variance) for variance in self._variances]

    def predict_curve(self, points: int = 200) -> tuple[Array, Array, Array]:
        """Return values of the only parameter, the predicted thrust, its half-width (95 %) [N]."""
        shares = np.linspace(0.0, 1.0, points)
        mean, covariance = self.predict_shares(shares[:, None])
        values = np.array([self.ranges[0].interpolate(float(share)) for share in shares])
        return values, mean, Z95 * np.sqrt(np.maximum(np.diag(covariance), 0.0))

    def predict_shares(self, shares: Array) -> tuple[Array, Array]:
        """Return the prediction at these places, shape (n,), and its covariance, shape (n, n)."""
        self._fit_noise()
        places = [dict(zip(self._names, map(float, place), strict=True)) for place in shares]
        return cast(tuple[Array, Array], self._library.predict(places, return_cov=True))

    def _expected_gain(self, shares: Array) -> tuple[Array, tuple[Array, Array]]:
        """Return the expected improvement at these places [N], the thrust and its covariance."""
        places: Array = np.vstack((shares, self._library.space.params))
        mean, covariance = self.predict_shares(places)
        deviation: Array = np.sqrt(np.maximum(np.diag(covariance), 1e-18))
        self._acquisition.y_max = mean[-self.trials :].max()
        n = len(shares)
        gain = cast(Array, self._acquisition.base_acq(mean[:n], deviation[:n]))
        return gain, (mean[:n], covariance[:n, :n])

    @property
    def _is_finite(self) -> bool:
        """Whether there is a single parameter with a list of possible values."""
        return len(self.ranges) == 1 and bool(self.ranges[0].values)

    def _fill_ranges(self) -> Array:
        """Return possible places that fill the ranges, as shares; shape (n, parameters)."""
        if self._is_finite:
            searched_alone = self.ranges[0]
            return np.array([[searched_alone.share(value)] for value in searched_alone.values])
        filling = np.linspace(0.0, 1.0, _GRID_POINTS)[:, None]
        if len(self.ranges) > 1:
            points = qmc.Halton(len(self.ranges), rng=self._seed).random(2 * _GRID_POINTS)
            filling = np.clip(1.05 * points - 0.025, 0.0, 1.0)  # includes the edges
        for index, searched in enumerate(self.ranges):
            if searched.values:
                filling[:, index] = [
                    searched.share(searched.value(share)) for share in filling[:, index]
                ]
        return filling

    def _find_untried(self, share: Array) -> Array:
        """Return the nearest possible place; of a list of values, one that was not measured yet."""
        if not self._is_finite:
            return share
        tried = self._library.space.params[:, 0] if self.trials else np.empty(0)
        new = [place for place in self._possible if not np.any(np.isclose(tried, place[0]))]
        return min(new or self._possible, key=lambda place: abs(float(place[0] - share[0])))

    def parameters_at(self, shares: Array) -> dict[str, float]:
        """Return the parameters at a place."""
        return {
            searched.name: searched.value(float(share))
            for searched, share in zip(self.ranges, shares, strict=True)
        }

    def _fit_noise(self) -> None:
        """Set the noise of each measurement, and the kernel, of the Gaussian process."""
        targets = self._library.space.target
        scale = float(np.std(targets)) or 1.0  # the process normalises by it
        least = (MIN_AMPLITUDE * float(np.mean(targets)) / scale) ** 2
        is_fitted = self.trials >= LENGTH_SCALE_FIT_TRIALS + 4 * (len(self.ranges) - 1)
        variance = max(1.0, least)
        amplitude = ConstantKernel(variance, (variance, 10.0 * variance) if is_fitted else "fixed")
        bounds = (LENGTH_SCALE / 2.0, LENGTH_SCALE * 4.0) if is_fitted else "fixed"
        self._library.set_gp_params(
            alpha=np.array(self._variances) / scale**2,
            kernel=amplitude * Matern([LENGTH_SCALE] * len(self.ranges), bounds, nu=2.5),
        )


class _NoisyImprovement(ExpectedImprovement):
    """Expected improvement over the best predicted mean, not over the highest noisy value."""

    def suggest(
        self,
        gp: Any,
        target_space: Any,
        n_random: int = 10_000,
        n_smart: int = 10,
        fit_gp: bool = True,
        random_state: Any = None,
    ) -> Any:
        """Return the next place; the library calls this method instead of its own."""
        self._fit_gp(gp=gp, target_space=target_space)
        self.y_max = gp.predict(target_space.params).max()
        return AcquisitionFunction.suggest(
            self, gp, target_space, n_random, n_smart, fit_gp=False, random_state=random_state
        )
