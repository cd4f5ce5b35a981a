"""Thrusts predicted by the identified fish, weighted by how well it explains the forces.

A thrust is modelled as that of the identified fish, times a factor common to all gaits, times a
deviation of each gait. The factor is unknown. The deviations are as large as the differences
between the fish of the cloud, and as the share of the forces that the fit does not explain. So a
fish that explains all forces determines how gaits compare, and one that explains little has no
influence beside a measurement.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fishd.lab.identification import Identification
from fishd.lab.statistics import Z95
from fishd.learning.adapt.results import Model

Array = NDArray[np.float64]

MODEL_ERROR = 0.01
"""Standard error of a thrust of an identified fish that fails no assumption, as a fraction."""
REJECTED = 0.01
"""Probability, under the identified fish, of a misfit at least as large; below it, the measured
thrusts reject it."""
_UNKNOWN_FACTOR = 10.0
"""Standard deviation of the common factor."""
_CORRELATED = 0.3
"""Correlation length of the deviations of square waves, as a logarithm of frequency."""


def model_of(identification: Identification) -> Model:
    """Return the quality of the identified fish as a model for the choice among gaits.

    A fish that is not identified is not used. Where one fails an assumption, the standard error of
    a thrust is as large as the rms of the force that it does not predict, as a fraction of that of
    the force.
    """
    explained = min(channel.explained_out_of_sample for channel in identification.channels)
    if not identification.failed_assumptions:
        return Model(explained_fraction=explained, standard_error=MODEL_ERROR)
    if not identification.identified:
        return Model(explained_fraction=explained, standard_error=None)
    error = math.hypot(MODEL_ERROR, math.sqrt(max(0.0, 1.0 - explained)))
    return Model(explained_fraction=explained, standard_error=error)


def deviations(curves: Array, error: float, correlation: Array | None = None) -> Array:
    """Return the covariance of the deviations of gaits, as fractions of their thrusts.

    curves: thrusts of the gaits on each fish of the cloud, the identified one first, (fish, gaits)
    error: as `Model.error`
    correlation: correlation between gaits of the unexplained deviations; by default none
    """
    gaits = curves.shape[1]
    ratios = curves[1:] / curves[0]
    if len(ratios):
        ratios = ratios / ratios.mean(axis=1, keepdims=True)  # without the common factor
    spread = (ratios - 1.0).T @ (ratios - 1.0) / max(1, len(ratios))
    own = np.eye(gaits) if correlation is None else correlation
    covariance: Array = spread + error**2 * own
    return covariance


def correlation_of_waves(frequencies: Sequence[float]) -> Array:
    """Return the correlation of the deviations of square waves; frequencies: [Hz]."""
    logs = np.log(frequencies)
    apart = (logs[:, None] - logs[None, :]) / _CORRELATED
    correlation: Array = np.exp(-0.5 * apart**2)
    return correlation


def combine(
    expected: Array, covariance: Array, places: Sequence[int], measured: Array, ci95: Array
) -> tuple[Array, Array]:
    """Return thrusts and their covariance, from the identified fish and from measurements.

    expected: thrusts of the gaits on the identified fish, all above zero [N]
    covariance: as `deviations` returns
    places: index of the gait of each measurement
    measured, ci95: thrusts, and half-widths of their 95 % confidence intervals [N]
    """
    at = list(places)
    prior = covariance + _UNKNOWN_FACTOR**2
    noise = np.diag((ci95 / Z95 / expected[at]) ** 2)
    gain = np.linalg.solve(prior[np.ix_(at, at)] + noise, prior[at]).T
    ratios = 1.0 + gain @ (measured / expected[at] - 1.0)
    left = prior - gain @ prior[at]
    return expected * ratios, left * np.outer(expected, expected)


def is_rejected(
    expected: Array, covariance: Array, places: Sequence[int], measured: Array, ci95: Array
) -> bool:
    """Return True where measurements disagree with the identified fish; arguments as `combine`."""
    at = list(places)
    ratios = measured / expected[at]
    noise = np.diag((ci95 / Z95 / expected[at]) ** 2)
    inverse = np.linalg.inv(covariance[np.ix_(at, at)] + noise)
    factor = float(inverse.sum(axis=0) @ ratios / inverse.sum())
    missed = float((ratios - factor) @ inverse @ (ratios - factor))
    return factor <= 0.0 or bool(chi2.sf(missed, max(1, len(at) - 1)) < REJECTED)
