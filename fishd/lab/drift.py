"""The force that swimming adds while the sensor drifts, separated from the drift by rests.

The force is measured in blocks, while the fish swims and while it rests. What swimming adds is
fitted by generalised least squares beside a level, a trend, and a drift of unknown kind and
strength: a random walk, and a smooth Gaussian process, which together follow most that sensors do.
Kinds and strengths are not chosen but averaged over, each weighed by its restricted likelihood
(REML; Patterson & Thompson, Biometrika 58 (1971) 545; Gaussian processes: Rasmussen & Williams,
Gaussian Processes for Machine Learning, 2006, section 2.7).

What no such drift describes is searched for (`fishd.lab.disturbances`): a step of the zero, a block
that is far off, and a zero that follows swimming. The result is averaged over the set of
disturbances that was found and all sets that differ from it by one disturbance.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.lab.disturbances import NAMED_ODDS, RESPONSE_TIMES_S, Disturbance, Search, candidates
from fishd.lab.statistics import Z95

Array = NDArray[np.float64]

WALKS = (0.0, 0.03, 0.5, 8.0)
"""Variances of the random walk after a second, over that of a block, that are tried."""
TIMES = (2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 40.0)
"""Correlation times of the smooth drift that are tried [s]."""
STRENGTHS = tuple(10.0**exponent for exponent in (-0.5, 0.75, 2.0, 3.25, 4.5))
"""Variances of the smooth drift, over that of a block, that are tried."""
LEAST_NOISE = 1e-3
"""Smallest variance of a block over that of an average one, for the covariances to be inverted."""
LEAST_BLOCKS = 6
"""Fewer say nothing about a drift."""
MAX_BLOCKS_AT_ONCE = 150
"""More blocks are fitted in parts, because time and memory grow faster than their number."""


class Blocks(NamedTuple):
    """Means of the force over short times, one after the other; arrays of n."""

    time: Array
    """The middle of each [s]."""
    force: Array
    """Mean force in it [N]."""
    variance: Array
    """Variance of that without drift, as neighbours differ [N²]."""
    swims: NDArray[np.bool_]
    """Did the fish swim? It rested where not."""
    responses: Array
    """First-order responses to swimming, for the last k of `RESPONSE_TIMES_S`; n×k."""


class Fit(NamedTuple):
    """What swimming adds to the force, and the drift below it."""

    force: float
    """[N]"""
    error: float
    """Half of the 95 % interval [N]."""
    drift: Array
    """The force without swimming, block by block [N]."""
    disturbances: Sequence[Disturbance] = ()
    """What was found beside a drift, and accounted for."""
    is_disturbed: bool = False
    """Were there as many disturbances as can be told apart, or more?"""


def fit(blocks: Blocks) -> Fit:
    """What swimming adds to the force, with an interval that knows what the drift may have done.

    Raises ValueError for fewer than `LEAST_BLOCKS` blocks, or without both swimming and rest.
    """
    n, swims = len(blocks.time), blocks.swims
    if n < LEAST_BLOCKS or swims.all() or not swims.any():
        raise ValueError("blocks of swimming and of rest are needed, six at least")
    parts = math.ceil(n / MAX_BLOCKS_AT_ONCE)
    pieces = (np.array_split(array, parts) for array in blocks)
    fits = [_fit(Blocks(*part)) for part in zip(*pieces, strict=True)]
    if parts == 1:
        return fits[0]
    weights = np.array([part.error**-2 for part in fits])
    return Fit(
        float(weights @ [part.force for part in fits] / weights.sum()),
        float(weights.sum() ** -0.5),
        np.concatenate([part.drift for part in fits]),
        [disturbance for part in fits for disturbance in part.disturbances],
        any(part.is_disturbed for part in fits),
    )


def _fit(blocks: Blocks) -> Fit:
    time, force, variance, swims, responses = blocks
    noise = np.maximum(variance / variance.mean(), LEAST_NOISE)
    precision, evidence = _precisions(time - time[0], noise)
    known = candidates(time, responses)
    swimming = swims.astype(np.float64)
    search = Search(precision, evidence, force, swimming, known, float(variance.mean()))
    chosen = search.find()
    mean, spread = search.average(chosen)
    sizes, drift = search.explain(chosen, noise)
    found = [
        _disturbance(candidate, size, time, responses.shape[1])
        for candidate, size in zip(chosen, sizes.tolist(), strict=True)
        if search.odds(chosen, candidate) >= NAMED_ODDS
    ]
    return Fit(mean, Z95 * spread**0.5, drift, found, search.is_full(chosen))


def _disturbance(candidate: int, size: float, time: Array, responses: int) -> Disturbance:
    """Return what a candidate is; they are in the order of `candidates`.

    responses: how many of them are responses
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

    Each drift counts as much as any other before the forces are seen: a kind that is added here
    with n strengths counts n times.

    seconds: middles of the blocks; noise: their variances, over that of an average one
    """
    walk = np.multiply.outer(WALKS, np.minimum.outer(seconds, seconds)) + np.diag(noise)
    gap = np.subtract.outer(seconds, seconds)
    covariances = np.concatenate(
        [
            walk + strength * np.exp(-0.5 * (gap / time) ** 2)
            for time in TIMES
            for strength in STRENGTHS
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
