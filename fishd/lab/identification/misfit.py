"""What a fitted model does not explain: prediction of data left out, and the error that it causes.

A model that lacks something of a fish errs differently at each frequency and amplitude. So data are
grouped by these: each group in turn is predicted from a fit of the others, and how much the groups
disagree on a parameter says how far it may be off.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fishd.lab.identification.fit import BOUNDS, LOGARITHMIC, SIGNED, Problem
from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import Array

Labels = NDArray[np.int_]

_MIN_GROUPS = 4
"""Smallest number of groups by frequency and amplitude; else data are grouped by time."""
_TIME_GROUPS = 8
"""Number of stretches of time, where data are grouped by time."""
_SHARE_OF_A_GROUP = 1.0 / 24.0
"""Smallest share of all windows in a group."""
LAGS = 20
"""Ticks that what is left over may be correlated for."""
_PROBED = 0.01
"""Size of slack and dead zone whose effect is compared with what is left over [rad]."""
_SINGULAR = 1e-10
"""Share of the largest eigenvalue below which information counts as zero."""


def groups(parts: Sequence[Passage], skips: Sequence[int]) -> Labels:
    """Return a group for each judged window, all passages in a row: one for similar half beats.

    skips: how many windows at the start of each passage are not judged
    """
    kinds = np.concatenate(
        [_kinds(part)[:, skip:] for part, skip in zip(parts, skips, strict=True)], axis=1
    )
    order = np.lexsort(kinds)
    changes = np.any(np.diff(kinds[:, order], axis=1) != 0, axis=0)
    smallest = _SHARE_OF_A_GROUP * order.size
    labels = np.zeros(order.size, dtype=np.int_)
    label, begin = 0, 0
    for end in (np.flatnonzero(changes) + 1).tolist():
        if end - begin >= smallest and order.size - end >= smallest:
            label, begin = label + 1, end
        labels[order[end:]] = label
    if label + 1 >= _MIN_GROUPS:
        return labels
    return np.arange(order.size) * _TIME_GROUPS // order.size


def _kinds(part: Passage) -> Labels:
    """Return length and height of the half beat of each window, in half octaves, (2, windows)."""
    side = np.sign(part.commands)
    begins = np.concatenate(([0], np.flatnonzero(np.diff(side)) + 1))
    lengths = np.diff(np.append(begins, side.size))
    heights = np.maximum.reduceat(np.abs(part.commands), begins)
    kinds = np.stack((lengths * part.tick, np.maximum(heights, 1e-3)))
    whole = np.round(2.0 * np.log2(kinds)).astype(np.int_)
    return np.repeat(whole, lengths, axis=1)[:, part.ends[1:] - 1]


def predicted(jacobian: Array, innovations: Array, labels: Labels) -> Array:
    """Return innovations of each group as a fit of the other groups leaves them, shape (2, n).

    jacobian: (2, n, names), of what is within its bounds
    innovations: of the fit of all, (2, n)
    labels: the group of each of the n
    """
    left = innovations.copy()
    information = np.einsum("cni,cnj->ij", jacobian, jacobian)
    score = np.einsum("cni,cn->i", jacobian, innovations)
    for label in np.unique(labels):
        inside = labels == label
        part, rest = jacobian[:, inside], innovations[:, inside]
        others = information - np.einsum("cni,cnj->ij", part, part)
        step = -_inverse(others) @ (score - np.einsum("cni,cn->i", part, rest))
        left[:, inside] = rest + part @ step
    return left


def disagreement(jacobian: Array, innovations: Array, labels: Labels) -> Array:
    """Return the covariance of a fit whose misfit is one draw for each group and force.

    The formula is that of standard errors robust to clusters (Liang and Zeger, "Longitudinal data
    analysis using generalized linear models"), with the groups as clusters.
    """
    inverse = _inverse(np.einsum("cni,cnj->ij", jacobian, jacobian))
    meat = np.zeros_like(inverse)
    count = 0
    for label in np.unique(labels):
        inside = labels == label
        for slopes, rest in zip(jacobian[:, inside], innovations[:, inside], strict=True):
            score = slopes.T @ rest
            meat += np.outer(score, score)
            count += 1
    covariance: Array = inverse @ meat @ inverse * (count / max(1, count - 1))
    return covariance


def likeness(column: Array, jacobian: Array, innovations: Array) -> tuple[float, float]:
    """Return how much of what is left over one more parameter would explain, and its value.

    The first is the fall of the sum of squares of the innovations, in units of noise².

    column: (2, n), derivative of the innovations by that parameter
    """
    slopes = jacobian.reshape(-1, jacobian.shape[2])
    inverse = _inverse(slopes.T @ slopes)
    new = column.ravel()
    new = new - slopes @ (inverse @ (slopes.T @ new))
    size = float(new @ new)
    if size <= _SINGULAR * float(column.ravel() @ column.ravel()):
        return 0.0, 0.0
    score = float(new @ innovations.ravel())
    return score * score / size, -score / size


def _inverse(information: Array) -> Array:
    """Return the inverse of a symmetric matrix without its directions of no information."""
    size = np.sqrt(np.maximum(np.diag(information), 0.0))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    kept = values > _SINGULAR * values[-1]
    scaled = vectors[:, kept] / values[kept] @ vectors[:, kept].T
    inverse: Array = scaled / np.outer(size, size)
    return inverse


def all_white(problem: Problem, values: dict[str, float]) -> bool:
    """Return whether what is left over of both forces is no more than noise."""
    return all(map(is_white, problem.whitened(problem.residuals(values))))


def likenesses(
    problem: Problem, values: dict[str, float], names: Sequence[str]
) -> list[tuple[str, float, float]]:
    """Return what is not fitted and looks like what is left over, the most alike first.

    Each is a name, the fall of the sum of squares in units of noise², and the likely value.
    """
    innovations = problem.whitened(problem.residuals(values))
    jacobian = problem.jacobian(values)[:, :, inside(problem.names, values)]
    found = []
    for name in names:
        if name in problem.names or values[name]:
            continue
        step = None if name in SIGNED else _PROBED
        fall, size = likeness(problem.column(values, name, step), jacobian, innovations)
        if name in SIGNED or size > 0.0:
            found.append((name, fall, size))
    return sorted(found, key=lambda each: -each[1])


def inside(names: Sequence[str], values: dict[str, float]) -> NDArray[np.bool_]:
    """Return which of what is fitted is not at an end of where a fit looks."""
    lows = [values[name] <= BOUNDS[name][0] + 1e-7 * BOUNDS[name][1] for name in names]
    ends = [at_end(name, values[name]) for name in names]
    free: NDArray[np.bool_] = ~(np.array(lows) | np.array(ends))
    return free


def is_white(innovations: Array) -> bool:
    """Return the answer of the test of Ljung and Box, at one in a thousand."""
    count = len(innovations)
    squares = float(innovations @ innovations)
    lags = range(1, min(LAGS, count - 1) + 1)
    correlations = [float(innovations[lag:] @ innovations[:-lag]) / squares for lag in lags]
    total = sum(r * r / (count - lag) for lag, r in zip(lags, correlations, strict=True))
    return bool(chi2.sf(count * (count + 2) * total, len(correlations)) > 1e-3)


def at_end(name: str, value: float) -> bool:
    """Return whether a value is at an end of where a fit looks, where that is not zero."""
    low, high = BOUNDS[name]
    if name in LOGARITHMIC:
        return value < 1.001 * low or value > 0.999 * high
    return value >= 0.999 * high or (name in SIGNED and value <= 0.999 * low)
