"""The force that swimming adds while the sensor drifts, told apart by rests.

The force is measured in blocks, while the fish swims and while it rests. What swimming adds is
fitted by generalised least squares beside a level, a trend, and a drift of unknown kind and
strength: a random walk, and a smooth Gaussian process, which together follow most that sensors do.
Kinds and strengths are not chosen but averaged over, each weighed by its restricted likelihood
(REML; Patterson & Thompson, Biometrika 58 (1971) 545; Gaussian processes: Rasmussen & Williams,
Gaussian Processes for Machine Learning, 2006, section 2.7).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WALKS = (0.0, 0.01, 0.1, 1.0, 10.0)
"""Variances of the random walk after a second, over that of a block, that are tried."""
TIMES = (2.5, 3.5, 5.0, 7.0, 10.0, 14.0, 20.0, 40.0)
"""Correlation times of the smooth drift that are tried [s]."""
STRENGTHS = tuple(10.0**exponent for exponent in range(-1, 6))
"""Variances of the smooth drift, over that of a block, that are tried."""
LEAST_BLOCKS = 6
"""Fewer say nothing about a drift."""


class Blocks(NamedTuple):
    """Means of the force over short times, one after the other; arrays of n."""

    time: Array
    """The middle of each [s]."""
    force: Array
    """Mean force in it [N]."""
    variance: Array
    """What that varies by, drift aside, up to a common factor."""
    swims: NDArray[np.bool_]
    """Did the fish swim? It rested where not."""


class Fit(NamedTuple):
    """What swimming adds to the force, and the drift below it."""

    force: float
    """[N]"""
    error: float
    """Half of the 95 % interval [N]."""
    drift: Array
    """The force without swimming, block by block [N]."""


def fit(blocks: Blocks) -> Fit:
    """What swimming adds to the force, with an interval that knows what the drift may have done.

    Raises ValueError for fewer than `LEAST_BLOCKS` blocks, or without both swimming and rest.
    """
    time, force, variance, swims = blocks
    n = len(time)
    if n < LEAST_BLOCKS or swims.all() or not swims.any():
        raise ValueError("blocks of swimming and of rest are needed, six at least")
    seconds = time - time[0]
    noise = np.diag(variance / variance.mean())
    known = np.column_stack((swims, np.ones(n), seconds - seconds.mean()))
    seen = np.column_stack((known, force))[np.newaxis]
    degrees = n - known.shape[1]
    weights, forces, variances, drifts = [], [], [], []
    for wandering in _covariances(seconds):
        factor = np.linalg.cholesky(noise + wandering)
        white = np.linalg.solve(factor, seen)
        q, r = np.linalg.qr(white[..., :-1])
        inverse = np.linalg.inv(r)
        beta = inverse @ (q.swapaxes(1, 2) @ white[..., -1:])
        left = white[..., -1:] - white[..., :-1] @ beta
        scale = (left**2).sum(axis=(1, 2)) / degrees
        weights.append(
            -np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            - np.log(np.abs(np.diagonal(r, axis1=1, axis2=2))).sum(axis=1)
            - 0.5 * degrees * np.log(scale)
        )
        forces.append(beta[:, 0, 0])
        unsure = (inverse[:, 0] ** 2).sum(axis=1)
        variances.append(scale * unsure * degrees / max(1, degrees - 2))
        pulled = np.linalg.solve(factor.swapaxes(1, 2), left)
        drifts.append((known[:, 1:] @ beta[:, 1:] + wandering @ pulled)[..., 0])
    likely = np.concatenate(weights)
    weight = np.exp(likely - likely.max())
    weight /= weight.sum()
    found = np.concatenate(forces)
    mean = float(weight @ found)
    spread = float(weight @ (np.concatenate(variances) + (found - mean) ** 2))
    return Fit(mean, 1.96 * spread**0.5, weight @ np.concatenate(drifts))


def _covariances(seconds: Array) -> Iterator[Array]:
    """Of all drifts that are tried, at these times; over the variance of a block.

    Several at once, shape (·, n, n), since numpy takes as long to be called as for a small matrix.
    Each counts as much as any other before the forces are seen: a kind that is added here with n
    strengths counts n times.
    """
    walk = np.minimum.outer(seconds, seconds)
    gap = np.subtract.outer(seconds, seconds)
    for time in TIMES:
        smooth = np.exp(-0.5 * (gap / time) ** 2)
        for strength in STRENGTHS:
            yield np.multiply.outer(WALKS, walk) + strength * smooth
