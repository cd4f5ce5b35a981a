"""The force that swimming adds while the sensor drifts, separated from the drift by rests.

The force is measured in blocks, while the fish swims and while it rests. What swimming adds is
fitted by generalised least squares beside a level, a trend, and a drift of unknown kind and
strength: a random walk, and a smooth Gaussian process, which together follow most that sensors do.
The result is an average over kinds and strengths, each weighted by its restricted likelihood
(REML; Patterson & Thompson, Biometrika 58 (1971) 545; Gaussian processes: Rasmussen & Williams,
Gaussian Processes for Machine Learning, 2006, section 2.7).

`fishd.lab.disturbances` searches for what no such drift describes: a step of the zero, a block
that is an outlier, and a zero that follows swimming. The result is averaged over the best set of
disturbances and all sets that differ from it by one disturbance.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.lab.disturbances import NAMED_ODDS, RESPONSE_TIMES_S, Disturbance, Search, candidates
from fishd.lab.statistics import Z95

Array = NDArray[np.float64]

WALK_VARIANCES = (0.0, 0.03, 0.5, 8.0)
"""Variances of the random walk after one second, over that of a block."""
CORRELATION_TIMES_S = (2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 40.0)
"""Correlation times of the smooth drift [s]."""
DRIFT_VARIANCES = tuple(10.0**exponent for exponent in (-0.5, 0.75, 2.0, 3.25, 4.5))
"""Variances of the smooth drift, over that of a block."""
MIN_NOISE = 1e-3
"""Smallest variance of a block over the mean one, so that covariances can be inverted."""
MIN_FIT_BLOCKS = 6
"""Smallest number of blocks in a fit."""
MAX_BLOCKS_AT_ONCE = 150
"""Largest number of blocks in one fit; more are fitted in parts, to limit time and memory."""


class Blocks(NamedTuple):
    """Means of the force over short times, one after the other; arrays of n."""

    time: Array
    """Time of the middle of each block [s]."""
    force: Array
    """Mean force of each block [N]."""
    variance: Array
    """Variance of `force` without drift, from the differences of neighbours [N²]."""
    swims: NDArray[np.bool_]
    """True for a block of a swim, False for a block of a rest."""
    responses: Array
    """First-order responses to swimming, for the last k of `RESPONSE_TIMES_S`; n×k."""


class Fit(NamedTuple):
    """The force that swimming adds, and the drift below it."""

    force: float
    """Force that swimming adds [N]."""
    force_ci95: float
    """Half-width of the 95 % confidence interval of `force` [N]."""
    drift: Array
    """Force that each block would have without swimming [N]."""
    disturbances: Sequence[Disturbance] = ()
    """Disturbances that the fit contains beside a drift."""
    is_disturbed: bool = False
    """True where there are as many disturbances as a fit may have, or more."""


def fit(blocks: Blocks) -> Fit:
    """Return the force that swimming adds, with an interval that allows for drift.

    Raises ValueError for fewer than `MIN_FIT_BLOCKS` blocks, or without both swimming and rest.
    """
    n, swims = len(blocks.time), blocks.swims
    if n < MIN_FIT_BLOCKS or swims.all() or not swims.any():
        raise ValueError("blocks of swimming and of rest are needed, six at least")
    parts = math.ceil(n / MAX_BLOCKS_AT_ONCE)
    pieces = (np.array_split(array, parts) for array in blocks)
    fits = [_fit(Blocks(*fit_of_part)) for fit_of_part in zip(*pieces, strict=True)]
    if parts == 1:
        return fits[0]
    weights = np.array([fit_of_part.force_ci95**-2 for fit_of_part in fits])
    return Fit(
        float(weights @ [fit_of_part.force for fit_of_part in fits] / weights.sum()),
        float(weights.sum() ** -0.5),
        np.concatenate([fit_of_part.drift for fit_of_part in fits]),
        [disturbance for fit_of_part in fits for disturbance in fit_of_part.disturbances],
        any(fit_of_part.is_disturbed for fit_of_part in fits),
    )


def _fit(blocks: Blocks) -> Fit:
    time, force, variance, swims, responses = blocks
    noise = np.maximum(variance / variance.mean(), MIN_NOISE)
    precision, evidence = _precisions(time - time[0], noise)
    all_candidates = candidates(time, responses)
    swimming = swims.astype(np.float64)
    search = Search(precision, evidence, force, swimming, all_candidates, float(variance.mean()))
    chosen = search.find()
    mean, spread = search.average(chosen)
    sizes, drift = search.explain(chosen, noise)
    named = [
        _disturbance(candidate, size, time, responses.shape[1])
        for candidate, size in zip(chosen, sizes.tolist(), strict=True)
        if search.odds(chosen, candidate) >= NAMED_ODDS
    ]
    return Fit(mean, Z95 * spread**0.5, drift, named, search.is_full(chosen))


def _disturbance(candidate: int, size: float, time: Array, responses: int) -> Disturbance:
    """Return the disturbance that a candidate stands for, by its index in `candidates`.

    responses: number of candidates that are responses
    """
    n = len(time)
    if candidate < n - 1:
        return Disturbance("step", size, float(0.5 * (time[candidate] + time[candidate + 1])))
    if candidate < 2 * n - 1:
        return Disturbance("outlier", size, float(time[candidate - n + 1]))
    constant = RESPONSE_TIMES_S[candidate - 2 * n + 1 - responses]
    return Disturbance("response", size, None, constant)


def _precisions(seconds: Array, noise: Array) -> tuple[Array, Array]:
    """Return the inverse covariance of each drift beside a level and a trend, and its evidence.

    All drifts have the same prior probability: a kind that is added with n strengths counts n
    times.

    seconds: times of the middles of the blocks; noise: their variances, over the mean one
    """
    walk = np.multiply.outer(WALK_VARIANCES, np.minimum.outer(seconds, seconds)) + np.diag(noise)
    gap = np.subtract.outer(seconds, seconds)
    covariances = np.concatenate(
        [
            walk + strength * np.exp(-0.5 * (gap / time) ** 2)
            for time in CORRELATION_TIMES_S
            for strength in DRIFT_VARIANCES
        ]
    )
    base = np.column_stack((np.ones(len(seconds)), seconds - seconds.mean()))
    factors = np.linalg.cholesky(covariances)
    evidence = -np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    del factors
    precision = np.linalg.inv(covariances)
    pulled = precision @ base
    information = base.T @ pulled
    precision -= pulled @ np.linalg.solve(information, pulled.swapaxes(1, 2))
    return precision, evidence - 0.5 * np.linalg.slogdet(information)[1]
