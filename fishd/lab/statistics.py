"""Confidence intervals: normal and Student's t quantiles, of a mean, and of a ratio."""

import math
from collections.abc import Sequence
from functools import cache
from statistics import stdev

from fishd.core.calibration import Z95 as Z95  # half-widths of the daemon use the same one


@cache
def student95(freedom: float) -> float:
    """Return the half-width of a 95 % interval, in standard errors, by Student's t.

    freedom: degrees of freedom; infinite for a standard error that is known
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
    """Return the mean of measurements and its half-width; they count by their inverse squares.

    Where they differ by more than their half-widths say, that of the mean is by Student's t.
    """
    weights = [1.0 / each**2 for each in ci95]
    mean = sum(w * value for w, value in zip(weights, values, strict=True)) / sum(weights)
    return mean, max(1.0 / math.sqrt(sum(weights)), mean_ci95(values) or 0.0)


def per_watt(
    thrust: float, ci95: float | None, watts: float | None, watts_ci95: float | None
) -> tuple[float, float] | tuple[None, None]:
    """Return the ratio of two means and its half-width [N/W], to the first order of the errors.

    Both are None where the power or a half-width is not known, or the servo takes no power.

    ci95, watts_ci95: half-width of the 95 % interval of each
    """
    if not watts or watts_ci95 is None or ci95 is None:
        return None, None
    ratio = thrust / watts
    return ratio, math.hypot(ci95 / watts, ratio * watts_ci95 / watts)
