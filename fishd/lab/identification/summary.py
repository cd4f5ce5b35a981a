"""Summary of a fit: values with intervals, explained variance, failed assumptions and remarks."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from scipy.ndimage import uniform_filter1d

from fishd.lab.identification.fit import BOUNDS, FURTHER, LOGARITHMIC, QUADRATIC, SIGNED, Problem
from fishd.lab.identification.misfit import (
    LAGS,
    are_free,
    find_missing_parameters,
    follows_commands,
    group_windows,
    is_at_bound,
    is_white,
    misfit_covariance,
    predict_groups,
)
from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import Array
from fishd.lab.identification.result import (
    PRODUCT_UNITS,
    UNITS,
    Channel,
    Estimate,
    Fit,
    Identification,
)
from fishd.lab.statistics import Z95, student95

OtherLaw: TypeAlias = tuple[float, dict[str, float]]
"""Fit with another law of the servo or other pulses: its `Problem.unexplained` above that of the
best one, and its values."""
LATERAL_INERTIA_FACTOR = 4.0
"""Factor that contains K_y/K over the configured value in 95 % of cases, if it is not fitted."""
SCALED = {
    "coupling": 1.0,
    "thrust_coefficient": -2.0,
    "lateral_inertia_ratio": 1.0,
    "lateral_drag": -1.0,
    "quadratic_drag": -1.0,
    "lateral_quadratic_drag": -2.0,
}
"""Exponents of K_y/K: forces do not change where all parameters change by these powers of it."""
MISFIT_FACTOR = 2.0
"""Factor on the errors from the disagreement of groups, as these are few and may share an error."""
MIN_EXPLAINED = 0.9
"""Smallest explained share of each force, out of sample, for which an incomplete model is given
intervals."""
_MIN_EXPLAINED_OF_NOISE = 0.05
"""Smallest explained share of the better force for a model whose residual is noise."""
_MAX_PREDICTION_RATIO = 1.1
"""Largest ratio of the sums of squared residuals out of sample and in sample."""
MIN_CLEAR_FALL = 25.0
"""Smallest fall of the sum of squares, in units of noise², that names a missing parameter."""
OFFSETS = ("offset_x", "offset_y")
_STRETCHES = (4, 5)
"""Numbers of stretches whose means give the error of the mean of a drift."""
_MAX_LOG_ERROR = 50.0
"""Largest error of a logarithm, to avoid an overflow."""
_SMOOTHING_S = 5.0
"""Length of the moving average of the displayed drift [s]."""
_SINGULAR = 1e-10
"""Relative eigenvalue below which information counts as zero."""
_SYMBOLS = {"fx": "F_x", "fy": "F_y"}
_SIGNS = {
    "white residual": "the residual of {} is more than noise",
    "prediction": "data left out of the fit are predicted worse in {}",
}
"""Clauses of the headline for failed assumptions about forces."""
_MIN_WIDTHS = {"servo_delay": 2e-3, "backlash": 2e-3}
"""Widths up to which an interval is narrow for any value [s], [rad]."""


def summarise(
    parts: Sequence[Passage],
    problem: Problem,
    values: dict[str, float],
    known: dict[str, float],
    scale_is_free: bool,
    others: Sequence[OtherLaw] = (),
) -> Identification:
    """Return the identification.

    known: values of all parameters, also of unused ones
    others: fits of the same parameters with other laws of the servo
    """
    all_values = {**known, **values}
    residuals = problem.residuals(values)
    innovations = problem.whitened(residuals)
    jacobian = problem.jacobian(values)
    statistical, unknown_direction = _covariance(jacobian, innovations)
    labels = group_windows(parts, problem.skips)
    free = are_free(problem.names, values)
    predicted = predict_groups(jacobian[:, :, free], innovations, labels)
    measured = problem.whitened(problem.measured)
    drifts = [_smooth(each, parts[0].tick) for each in residuals]
    channels = tuple(
        Channel(
            name,
            explained=_explained_share(left, whole),
            explained_out_of_sample=_explained_share(unseen, whole),
            noise=noise.white,
            drift=float(max(d[k].max() for d in drifts) - min(d[k].min() for d in drifts)),
            white=is_white(left) and not follows_commands(parts, problem.skips, left),
        )
        for k, (name, left, unseen, whole, noise) in enumerate(
            zip(("fx", "fy"), innovations, predicted, measured, problem.noise, strict=True)
        )
    )
    failed = _failed_assumptions(channels, innovations, predicted)
    covariance, inflation = statistical, 1.0
    if failed:
        covariance = statistical + MISFIT_FACTOR**2 * misfit_covariance(
            jacobian, innovations, labels
        )
        inflation = _inflation(covariance, statistical)
    covariance = covariance + _spread_of_laws(problem, values, others, inflation)
    if failed:
        inflation = _inflation(covariance, statistical)
        rest = [name for name in (*FURTHER, *QUADRATIC, "rotation") if name not in problem.names]
        candidates = find_missing_parameters(problem, values, rest)
        failed = [
            *(f"{name} = 0" for name, fall, _ in candidates[:1] if fall > MIN_CLEAR_FALL),
            *failed,
        ]
    shares = [channel.explained_out_of_sample for channel in channels]
    identified = min(shares) >= MIN_EXPLAINED if failed else max(shares) >= _MIN_EXPLAINED_OF_NOISE
    deviations = np.sqrt(np.diag(covariance))
    half_widths = dict(zip(problem.names, (Z95 * deviations).tolist(), strict=True))
    if not identified:
        half_widths = dict.fromkeys(half_widths, np.inf)
    estimates = [
        make_estimate(name, all_values[name], half_widths) for name in UNITS if name in all_values
    ]
    if scale_is_free:
        estimates = [_with_free_scale(each) for each in estimates]
    left = np.concatenate(residuals, axis=1)
    slopes = problem.slopes_of_means(values)
    means = np.concatenate(problem.forces(values), axis=1).mean(axis=1)
    for name, channel_residual, slope, noise, mean, channel in zip(
        OFFSETS, left, slopes, problem.noise, means, channels, strict=True
    ):
        fit_error = Z95 * np.sqrt(
            slope @ covariance @ slope + noise.white**2 / channel_residual.size
        )
        if failed:  # a mean force may be as wrong as its variation, which a drift hides
            lost = max(0.0, 1.0 - channel.explained_out_of_sample)
            fit_error = np.hypot(fit_error, Z95 * np.sqrt(lost) * mean)
        error = float(np.hypot(fit_error, _drift_error(channel_residual)))
        value = float(channel_residual.mean())
        estimates.append(Estimate(name, value, value - error, value + error))
    return Identification(
        headline=_headline(channels, failed, identified, inflation)
        + (_assumed_ratio(all_values) if scale_is_free and identified else ""),
        identified=identified,
        estimates=tuple(estimates),
        products=make_products(problem.names, all_values, covariance, identified),
        channels=(channels[0], channels[1]),
        seconds=sum(passage.duration for passage in parts),
        passages=len(parts),
        remarks=_remarks(problem.names, estimates, unknown_direction),
        names=problem.names,
        covariance=covariance,
        inflation=inflation,
        failed_assumptions=tuple(failed),
        fit=_to_fit(problem, values, drifts),
        servo_law=problem.law,
    )


def _inflation(covariance: Array, statistical: Array) -> float:
    """Return the median ratio of errors to those from noise alone."""
    return float(np.median(np.sqrt(np.diag(covariance) / np.diag(statistical))))


def _spread_of_laws(
    problem: Problem,
    values: dict[str, float],
    others: Sequence[OtherLaw],
    inflation: float,
) -> Array:
    """Return the covariance of z from not knowing the law of the servo and the size of its steps.

    Each fit counts with its likelihood relative to that of the best one. Where the model is
    incomplete, a difference in likelihood is less certain, by the square of the inflation.
    """
    z = problem.to_z(values)
    count = sum(measured.shape[1] for measured in problem.measured)
    spread = np.zeros((len(z), len(z)))
    for excess, other_values in others:
        difference = problem.to_z(other_values) - z
        spread += np.exp(-count * excess / inflation**2) * np.outer(difference, difference)
    return spread


def _failed_assumptions(
    channels: Sequence[Channel], innovations: Array, predicted: Array
) -> list[str]:
    """Return the assumptions about residuals that do not hold."""
    failed = [f"white residual of {channel.name}" for channel in channels if not channel.white]
    for channel, fitted, left_out in zip(channels, innovations, predicted, strict=True):
        if left_out @ left_out > _MAX_PREDICTION_RATIO * (fitted @ fitted):
            failed.append(f"prediction of {channel.name}")
    return failed


def _explained_share(residual: Array, measured: Array) -> float:
    """Return the share of the variance that is explained, from residual and measured forces."""
    return float(1.0 - (residual @ residual) / (measured @ measured))


def _with_free_scale(estimate: Estimate) -> Estimate:
    """Return the estimate with an interval that allows for the uncertainty of K_y/K."""
    if estimate.name not in SCALED:
        return estimate
    factor = LATERAL_INERTIA_FACTOR ** abs(SCALED[estimate.name])
    low, high = estimate.ci95_low / factor, estimate.ci95_high * factor
    if estimate.name == "lateral_inertia_ratio":
        return replace(estimate, ci95_low=low, ci95_high=high, fitted=True)
    if not estimate.fitted:
        return estimate
    return replace(
        estimate,
        ci95_low=low,
        ci95_high=high,
        if_ratio_holds=(estimate.ci95_low, estimate.ci95_high),
    )


def make_products(
    names: Sequence[str], values: dict[str, float], covariance: Array, identified: bool
) -> tuple[Estimate, ...]:
    """Return K λ², K_y λ and K_d λ with their intervals."""
    scale, inertia = values["coupling"], values["thrust_coefficient"]
    ratio, drag = values["lateral_inertia_ratio"], values["lateral_drag"]
    products = []
    for name, value, exponents in zip(
        PRODUCT_UNITS,
        (inertia * scale * scale, ratio * inertia * scale, drag * scale),
        (
            {"coupling": 2.0, "thrust_coefficient": 1.0},
            {"coupling": 1.0, "thrust_coefficient": 1.0, "lateral_inertia_ratio": 1.0},
            {"coupling": 1.0, "lateral_drag": 1.0},
        ),
        strict=True,
    ):
        slope = np.array([exponents.get(parameter, 0.0) * value for parameter in names])
        if "lateral_drag" in exponents and "lateral_drag" in names:  # not fitted as a logarithm
            slope[list(names).index("lateral_drag")] = scale
        error = Z95 * float(np.sqrt(slope @ covariance @ slope)) if identified else np.inf
        products.append(Estimate(name, value, max(0.0, value - error), value + error))
    return tuple(products)


def _headline(
    channels: Sequence[Channel], failed: Sequence[str], identified: bool, inflation: float
) -> str:
    """Return the headline of the identification."""
    explained = " and ".join(
        f"{_percent(channel.explained_out_of_sample)} of {_SYMBOLS[channel.name]}"
        for channel in channels
    )
    if not failed and identified:
        return f"identified: the model explains {explained}"
    if not failed:
        return f"not identified: the model explains {explained}: the rest is noise"
    causes = [assumption for assumption in failed if assumption.endswith(" = 0")]
    reasons = "; ".join(
        clause.format(" and ".join(symbols))
        for assumption_kind, clause in _SIGNS.items()
        if (
            symbols := [
                s for name, s in _SYMBOLS.items() if f"{assumption_kind} of {name}" in failed
            ]
        )
    )
    if causes:
        reasons += f"; it looks as if {causes[0].replace(' = 0', ' is not 0')}"
    if not identified:
        return f"not identified: the model explains {explained}: {reasons}"
    widening = f"intervals are {inflation:.2g} times as wide as noise alone makes them"
    return f"careful: the model is incomplete and explains {explained}: {reasons}; {widening}"


def _assumed_ratio(values: dict[str, float]) -> str:
    """Return the clause of the headline about the ratio that the data do not determine."""
    ratio = values["lateral_inertia_ratio"]
    low, high = ratio / LATERAL_INERTIA_FACTOR, ratio * LATERAL_INERTIA_FACTOR
    return f"; λ, K and K_d hold for K_y/K from {low:.3g} to {high:.3g}"


def _percent(share: float) -> str:
    """Return a share with enough digits to differ from 100 %: 71 %, 99.63 %, 99.9950 %."""
    unexplained = max(1.0 - share, 1e-6)
    digits = min(4, max(0, -math.floor(math.log10(unexplained)) - 1))
    return f"{100.0 * max(share, 0.0):.{digits}f} %"


def _covariance(jacobian: Array, innovations: Array) -> tuple[Array, Array | None]:
    """Return the covariance of the errors of z, and a direction of z without information, or None.

    Where the residual is correlated from tick to tick, the error is larger than for white noise
    (Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation
    consistent covariance matrix").
    """
    size = np.sqrt((jacobian**2).sum(axis=(0, 1)))
    size[size == 0.0] = 1.0
    scaled = jacobian / size
    information = np.einsum("cni,cnj->ij", scaled, scaled)
    values, vectors = np.linalg.eigh(information)
    weak = values < _SINGULAR * values[-1]
    inverse = (vectors / np.where(weak, _SINGULAR * values[-1], values)) @ vectors.T
    scores = scaled * innovations[:, :, None]
    meat = np.einsum("cni,cnj->ij", scores, scores)
    for lag in range(1, LAGS + 1):
        product = np.einsum("cni,cnj->ij", scores[:, lag:], scores[:, :-lag])
        meat += (1.0 - lag / (LAGS + 1)) * (product + product.T)
    robust = inverse @ meat @ inverse
    wider = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    unscaled = wider / size
    return inverse * np.outer(unscaled, unscaled), vectors[:, 0] if weak[0] else None


def _drift_error(residual: Array) -> float:
    """Return the half-width of the 95 % interval of a mean, from the means of stretches [N].

    It holds for any drift for which all stretches are alike (Ibragimov and Müller,
    "t-statistic based correlation and heterogeneity robust inference").
    """
    halves = []
    for count in _STRETCHES:  # a drift whose period is one stretch shows in the other division
        means = [stretch.mean() for stretch in np.array_split(residual, count)]
        deviation = np.std(means, ddof=1) / np.sqrt(count)
        halves.append(float(student95(count - 1) * deviation))
    return max(halves)


def make_estimate(name: str, value: float, half_widths: dict[str, float]) -> Estimate:
    """Return a parameter with its interval; half_widths: of the fitted ones, as fitted."""
    half_width = half_widths.get(name)
    if half_width is None:
        return Estimate(name, value, value, value, fitted=False)
    if name in LOGARITHMIC:  # a relative error: the interval is not symmetric
        high = (
            value * float(np.exp(min(half_width, _MAX_LOG_ERROR)))
            if np.isfinite(half_width)
            else np.inf
        )
        return Estimate(name, value, value * float(np.exp(-half_width)), high)
    low = value - half_width if name in SIGNED else max(0.0, value - half_width)
    return Estimate(name, value, low, value + half_width)


def _smooth(residual: Array, tick: float) -> Array:
    width = min(max(1, round(_SMOOTHING_S / tick)), residual.shape[1])
    smoothed: Array = uniform_filter1d(residual, width, axis=1, mode="nearest")
    return smoothed


def _to_fit(problem: Problem, values: dict[str, float], drifts: Sequence[Array]) -> Fit:
    gap = np.full((1,), np.nan)
    gaps = np.full((2, 1), np.nan)

    def joined(parts: Sequence[Array]) -> Array:
        between = gap if parts[0].ndim == 1 else gaps
        pieces = [piece for part in parts for piece in (part, between)][:-1]
        return np.concatenate(pieces, axis=-1)

    forces = problem.forces(values)
    return Fit(*map(joined, (problem.times, problem.measured, forces, drifts)))


def _remarks(
    names: Sequence[str], estimates: Sequence[Estimate], unknown_direction: Array | None
) -> tuple[str, ...]:
    remarks = []
    if unknown_direction is not None:
        involved = [
            name for name, part in zip(names, unknown_direction, strict=True) if abs(part) > 0.3
        ]
        remarks.append(
            f"these data do not determine {' and '.join(involved)}"
            + (" separately" if len(involved) > 1 else "")
            + "; fix one, or run fishctl identify --experiment"
        )
    imprecise = [e.name for e in estimates if e.name in names and _is_wide(e)]
    if imprecise:
        remarks.append(f"known to 10 % at best: {', '.join(imprecise)}")
    at_bounds = [
        f"{name} = {value:.4g}"
        for name, value in ((e.name, e.value) for e in estimates if e.name in BOUNDS)
        if is_at_bound(name, value)
    ]
    if at_bounds:
        remarks.append(f"at a bound of the fit: {', '.join(at_bounds)}")
    return tuple(remarks)


def _is_wide(estimate: Estimate) -> bool:
    """Return whether the interval is wider than ±10 % of the value, and ±1 ms or ±1 mrad."""
    low, high = estimate.narrowest_interval
    if not estimate.fitted or not math.isfinite(high):
        return False
    if estimate.name in LOGARITHMIC:
        return high > 1.2 * low
    smallest = _MIN_WIDTHS.get(estimate.name)
    return smallest is not None and high - low > max(0.2 * estimate.value, smallest)
