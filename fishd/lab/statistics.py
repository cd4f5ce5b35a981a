"""Confidence intervals of a mean and of a ratio; quantiles of Student's t."""

import math
from collections.abc import Sequence
from functools import cache
from statistics import stdev

from fishd.core.calibration import (
    Z95 as Z95,
)  # the daemon computes half-widths with the same quantile


@cache
def student95(freedom: float) -> float:
    """Return the half-width of a 95 % interval, in standard errors, by Student's t.

    freedom: degrees of freedom; infinite for a known standard error
    """
    return quantile(0.975, freedom)


@cache
def quantile(probability: float, freedom: float = math.inf) -> float:
    """Return a quantile of Student's t distribution."""
    from scipy.special import ndtri, stdtrit  # scipy.stats takes a second to load

    return float(ndtri(probability) if math.isinf(freedom) else stdtrit(freedom, probability))


def mean_ci95(values: Sequence[float]) -> float | None:
    """Return the half-width of the 95 % interval of a mean; None for a single value."""
    if len(values) < 2:
        return None
    return student95(len(values) - 1) * stdev(values) / math.sqrt(len(values))


def weighted_mean(values: Sequence[float], ci95: Sequence[float]) -> tuple[float, float]:
    """Return the mean of measurements, weighted by inverse squared half-widths, and its half-width.

    Where the values scatter by more than their half-widths, the result uses Student's t.
    """
    weights = [1.0 / half_width**2 for half_width in ci95]
    mean = sum(weight * value for weight, value in zip(weights, values, strict=True)) / sum(weights)
    return mean, max(1.0 / math.sqrt(sum(weights)), mean_ci95(values) or 0.0)


def per_watt(
    thrust: float, ci95: float | None, watts: float | None, watts_ci95: float | None
) -> tuple[float, float] | tuple[None, None]:
    """Return the ratio of two means and its half-width [N/W], to first order in the errors.

    Both are None where the power or a half-width is unknown, or the power is zero.

    ci95, watts_ci95: half-widths of the 95 % intervals of thrust and power
    """
    if not watts or watts_ci95 is None or ci95 is None:
        return None, None
    ratio = thrust / watts
    return ratio, math.hypot(ci95 / watts, ratio * watts_ci95 / watts)
