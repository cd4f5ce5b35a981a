"""Misfit of a fitted model: cross-validation, and the error of the parameters that it causes.

The error of an incomplete model depends on frequency and amplitude, so data are grouped by these.
Each group is predicted from a fit of the others, and the disagreement of the groups on a parameter
gives its error.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from fishd.lab.identification.fit import BOUNDS, LOGARITHMIC, SIGNED, Problem
from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import Array

Labels = NDArray[np.int_]

_MIN_GROUPS = 4
"""Smallest number of groups by frequency and amplitude; with fewer, data are grouped by time."""
_TIME_GROUPS = 8
"""Number of groups where data are grouped by time."""
_MIN_GROUP_SHARE = 1.0 / 24.0
"""Smallest share of all windows in a group."""
MIN_TESTED_WINDOWS = 80
"""Number of windows from which `follows_commands` sees the force of a fish that swims."""
_STEP_LAGS = 10
"""Number of windows after a step of the command in which its effect on a residual is tested."""
LAGS = 20
"""Largest lag at which the correlation of residuals is considered [ticks]."""
_PROBE_SIZE_RAD = 0.01
"""Size of slack and dead zone whose effect is compared with the residual [rad]."""
_SINGULAR = 1e-10
"""Relative eigenvalue below which information counts as zero."""


def group_windows(parts: Sequence[Passage], skips: Sequence[int]) -> Labels:
    """Return the group of each window, passages joined; a group holds similar half beats.

    skips: number of windows at the start of each passage that are left out
    """
    kinds = np.concatenate(
        [_kinds(part)[:, skip:] for part, skip in zip(parts, skips, strict=True)], axis=1
    )
    order = np.lexsort(kinds)
    changes = np.any(np.diff(kinds[:, order], axis=1) != 0, axis=0)
    smallest = _MIN_GROUP_SHARE * order.size
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


def _step_columns(part: Passage) -> Array:
    """Return by window whether a large or small step, up or down, was 0, 1, … windows before.

    The shape is (windows, 4 × `_STEP_LAGS`).
    """
    held = np.concatenate((part.commands[:1], part.commands[part.ends[1:] - 1]))
    steps = np.diff(held)
    sizes = np.abs(steps)
    large = sizes > 0.5 * sizes.max(initial=0.0)
    kinds = [(steps > 0.0) & large, (steps < 0.0) & large, (steps > 0.0) & ~large,
             (steps < 0.0) & ~large]  # fmt: skip
    columns = [
        np.concatenate((np.zeros(lag), kind[: kind.size - lag]))
        for kind in kinds
        for lag in range(min(_STEP_LAGS, steps.size))
    ]
    return np.stack(columns, axis=1)


def predict_groups(jacobian: Array, innovations: Array, labels: Labels) -> Array:
    """Return the innovations of each group for a fit of the other groups, shape (2, n).

    jacobian: derivatives by the parameters that are not at a bound, (2, n, names)
    innovations: innovations of the fit of all groups, (2, n)
    labels: group of each window, (n,)
    """
    predictions = innovations.copy()
    information = np.einsum("cni,cnj->ij", jacobian, jacobian)
    score = np.einsum("cni,cn->i", jacobian, innovations)
    for label in np.unique(labels):
        in_group = labels == label
        own_jacobian, own_innovations = jacobian[:, in_group], innovations[:, in_group]
        others = information - np.einsum("cni,cnj->ij", own_jacobian, own_jacobian)
        step = -_inverse(others) @ (score - np.einsum("cni,cn->i", own_jacobian, own_innovations))
        predictions[:, in_group] = own_innovations + own_jacobian @ step
    return predictions


def misfit_covariance(jacobian: Array, innovations: Array, labels: Labels) -> Array:
    """Return the covariance of a fit whose misfit is independent between groups and forces.

    The formula is that of standard errors robust to clusters (Liang and Zeger, "Longitudinal data
    analysis using generalized linear models"), with the groups as clusters.
    """
    inverse = _inverse(np.einsum("cni,cnj->ij", jacobian, jacobian))
    meat = np.zeros_like(inverse)
    count = 0
    for label in np.unique(labels):
        in_group = labels == label
        for slopes, residual in zip(jacobian[:, in_group], innovations[:, in_group], strict=True):
            score = slopes.T @ residual
            meat += np.outer(score, score)
            count += 1
    covariance: Array = inverse @ meat @ inverse * (count / max(1, count - 1))
    return covariance


def explained_by(column: Array, jacobian: Array, innovations: Array) -> tuple[float, float]:
    """Return the fall of the sum of squares that one more parameter would cause, and its value.

    The fall is that of the innovations, in units of noise².

    column: derivative of the innovations by that parameter, (2, n)
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
    """Return the inverse of a symmetric matrix, 0 in directions without information."""
    size = np.sqrt(np.maximum(np.diag(information), 0.0))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    kept = values > _SINGULAR * values[-1]
    scaled = vectors[:, kept] / values[kept] @ vectors[:, kept].T
    inverse: Array = scaled / np.outer(size, size)
    return inverse


def all_white(problem: Problem, values: dict[str, float]) -> bool:
    """Return whether the residuals of both forces are white noise."""
    return all(map(is_white, problem.whitened(problem.residuals(values))))


def find_missing_parameters(
    problem: Problem, values: dict[str, float], names: Sequence[str]
) -> list[tuple[str, float, float]]:
    """Return parameters that would explain a part of the residual, the largest part first.

    Each item is a name, the fall of the sum of squares in units of noise², and the likely value.
    """
    innovations = problem.whitened(problem.residuals(values))
    jacobian = problem.jacobian(values)[:, :, are_free(problem.names, values)]
    candidates = []
    for name in names:
        if name in problem.names or values[name]:
            continue
        step = None if name in SIGNED else _PROBE_SIZE_RAD
        fall, size = explained_by(problem.column(values, name, step), jacobian, innovations)
        if name in SIGNED or size > 0.0:
            candidates.append((name, fall, size))
    return sorted(candidates, key=lambda candidate: -candidate[1])


def are_free(names: Sequence[str], values: dict[str, float]) -> NDArray[np.bool_]:
    """Return which fitted parameters are not at a bound."""
    at_lower_bounds = [values[name] <= BOUNDS[name][0] + 1e-7 * BOUNDS[name][1] for name in names]
    at_bounds = [is_at_bound(name, values[name]) for name in names]
    free: NDArray[np.bool_] = ~(np.array(at_lower_bounds) | np.array(at_bounds))
    return free


def is_white(innovations: Array) -> bool:
    """Return whether innovations pass the Ljung-Box test at a level of 0.001."""
    count = len(innovations)
    squares = float(innovations @ innovations)
    lags = range(1, min(LAGS, count - 1) + 1)
    correlations = [float(innovations[lag:] @ innovations[:-lag]) / squares for lag in lags]
    total = sum(r * r / (count - lag) for lag, r in zip(lags, correlations, strict=True))
    return bool(chi2.sf(count * (count + 2) * total, len(correlations)) > 1e-3)


def follows_commands(parts: Sequence[Passage], skips: Sequence[int], innovations: Array) -> bool:
    """Return whether innovations of a force depend on recent steps of the command.

    A regression on large and small steps, and on their directions, at each of the last windows
    explains more than noise would, once in a thousand. It sees errors of the model that are far
    below the noise of one tick.

    skips: number of windows at the start of each passage that are left out
    """
    columns = np.concatenate(
        [_step_columns(part)[skip:] for part, skip in zip(parts, skips, strict=True)]
    )
    left = np.linalg.lstsq(columns, innovations)[0]
    explained = float(np.sum((columns @ left) ** 2))
    rank = columns.shape[1]
    if len(innovations) <= rank:
        return False  # too few windows to tell
    noise = float(innovations @ innovations) - explained
    return bool(
        f_distribution.sf(
            explained / rank / (noise / (len(innovations) - rank)), rank, len(innovations) - rank
        )
        < 1e-3
    )


def is_at_bound(name: str, value: float) -> bool:
    """Return whether a value is at a bound other than zero."""
    low, high = BOUNDS[name]
    if name in LOGARITHMIC:
        return value < 1.001 * low or value > 0.999 * high
    return value >= 0.999 * high or (name in SIGNED and value <= 0.999 * low)
