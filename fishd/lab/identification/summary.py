"""What a fit says: values with intervals, how well they explain the forces, and its doubts."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from fishd.lab.identification import misfit
from fishd.lab.identification.fit import BOUNDS, FURTHER, LOGARITHMIC, QUADRATIC, SIGNED, Problem
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

LATERAL_INERTIA_FACTOR = 2.0
"""K_y/K is within this factor of the configured one, in 95 % of cases, where no data tell it."""
SCALED = {
    "coupling": 1.0,
    "thrust_coefficient": -2.0,
    "lateral_inertia_ratio": 1.0,
    "lateral_drag": -1.0,
    "quadratic_drag": -1.0,
    "lateral_quadratic_drag": -2.0,
}
"""Exponents of K_y/K: all of these may change with it in this way, and no force changes."""
MISFIT_FACTOR = 2.0
"""By how much the disagreement between groups of data is multiplied: there are few groups, and what
all of them have in common does not show."""
MIN_EXPLAINED = 0.9
"""Smallest share of each force, out of sample, with which intervals are shown after a misfit."""
_WORSE = 1.1
"""Largest ratio of squares of what is left over, out of sample to in sample."""
CLEAR = 25.0
"""Smallest fall of the sum of squares, in units of noise², that names what the model lacks."""
OFFSETS = ("offset_x", "offset_y")
_STRETCHES = (4, 5)
"""Into how many stretches runs are cut, whose means tell how well the mean of a drift is known."""
_UNKNOWN = 50.0
"""Error of a logarithm that says nothing any more."""
_SMOOTH = 5.0
"""For the drift that is shown [s]."""
_SINGULAR = 1e-10
"""Information below this share of the largest is none."""
_SYMBOLS = {"fx": "F_x", "fy": "F_y"}
_SIGNS = {
    "white residual": "what is left of {} is more than noise",
    "prediction": "data left out of the fit are predicted worse in {}",
}
"""Failed assumptions, as a clause of a sentence about forces."""
_SMALLEST = {"servo_delay": 2e-3, "backlash": 2e-3}
"""Width of an interval that is narrow enough, however small the value is [s], [rad]."""


def summarise(
    parts: Sequence[Passage],
    problem: Problem,
    values: dict[str, float],
    known: dict[str, float],
    scale_is_free: bool,
) -> Identification:
    """Return what is found; `known` holds what the model does not use, too."""
    all_values = {**known, **values}
    residuals = problem.residuals(values)
    innovations = problem.whitened(residuals)
    jacobian = problem.jacobian(values)
    statistical, untold = _covariance(jacobian, innovations)
    labels = misfit.groups(parts, problem.skips)
    inside = misfit.inside(problem.names, values)
    predicted = misfit.predicted(jacobian[:, :, inside], innovations, labels)
    measured = problem.whitened(problem.measured)
    drifts = [_smoothed(each, parts[0].tick) for each in residuals]
    channels = tuple(
        Channel(
            name,
            explained=_share(left, whole),
            explained_out_of_sample=_share(unseen, whole),
            noise=noise.white,
            drift=float(max(d[k].max() for d in drifts) - min(d[k].min() for d in drifts)),
            white=misfit.is_white(left),
        )
        for k, (name, left, unseen, whole, noise) in enumerate(
            zip(("fx", "fy"), innovations, predicted, measured, problem.noise, strict=True)
        )
    )
    failed = _failed(channels, innovations, predicted)
    covariance, inflation = statistical, 1.0
    if failed:
        further = misfit.disagreement(jacobian, innovations, labels)
        covariance = statistical + MISFIT_FACTOR**2 * further
        inflation = float(np.median(np.sqrt(np.diag(covariance) / np.diag(statistical))))
        rest = [name for name in (*FURTHER, *QUADRATIC, "rotation") if name not in problem.names]
        alike = misfit.likenesses(problem, values, rest)
        failed = [*(f"{name} = 0" for name, fall, _ in alike[:1] if fall > CLEAR), *failed]
    identified = not failed or all(c.explained_out_of_sample >= MIN_EXPLAINED for c in channels)
    deviations = np.sqrt(np.diag(covariance))
    spread = dict(zip(problem.names, (Z95 * deviations).tolist(), strict=True))
    if not identified:
        spread = dict.fromkeys(spread, np.inf)
    estimates = [_estimate(name, all_values[name], spread) for name in UNITS if name in all_values]
    if scale_is_free:
        estimates = [_with_free_scale(each) for each in estimates]
    left = np.concatenate(residuals, axis=1)
    slopes = problem.slopes_of_means(values)
    means = np.concatenate(problem.forces(values), axis=1).mean(axis=1)
    for name, of, slope, noise, mean, channel in zip(
        OFFSETS, left, slopes, problem.noise, means, channels, strict=True
    ):
        told = Z95 * np.sqrt(slope @ covariance @ slope + noise.white**2 / of.size)
        if failed:  # a mean force may be as wrong as the rest of it, and no drift shows that
            lost = max(0.0, 1.0 - channel.explained_out_of_sample)
            told = np.hypot(told, Z95 * np.sqrt(lost) * mean)
        error = float(np.hypot(told, _wandering(of)))
        value = float(of.mean())
        estimates.append(Estimate(name, value, value - error, value + error))
    return Identification(
        headline=_headline(channels, failed, identified, inflation),
        identified=identified,
        estimates=tuple(estimates),
        products=_products(problem.names, all_values, covariance, identified),
        channels=(channels[0], channels[1]),
        seconds=sum(one.duration for one in parts),
        passages=len(parts),
        remarks=_remarks(problem.names, estimates, untold),
        names=problem.names,
        covariance=covariance,
        inflation=inflation,
        failed_assumptions=tuple(failed),
        fit=_series(problem, values, drifts),
    )


def _failed(channels: Sequence[Channel], innovations: Array, predicted: Array) -> list[str]:
    """Return the assumptions about what is left over that do not hold."""
    failed = [f"white residual of {channel.name}" for channel in channels if not channel.white]
    for channel, fitted, unseen in zip(channels, innovations, predicted, strict=True):
        if unseen @ unseen > _WORSE * (fitted @ fitted):
            failed.append(f"prediction of {channel.name}")
    return failed


def _share(left: Array, whole: Array) -> float:
    """Return the share of the variance that is explained."""
    return float(1.0 - (left @ left) / (whole @ whole))


def _with_free_scale(estimate: Estimate) -> Estimate:
    """Return the estimate with an interval for any K_y/K that is within reason."""
    if estimate.name not in SCALED:
        return estimate
    factor = LATERAL_INERTIA_FACTOR ** abs(SCALED[estimate.name])
    low, high = estimate.low / factor, estimate.high * factor
    if estimate.name == "lateral_inertia_ratio":
        return replace(estimate, low=low, high=high, fitted=True)
    if not estimate.fitted:
        return estimate
    return replace(estimate, low=low, high=high, if_ratio_holds=(estimate.low, estimate.high))


def _products(
    names: Sequence[str], values: dict[str, float], covariance: Array, identified: bool
) -> tuple[Estimate, ...]:
    """Return K λ², K_y λ and K_d λ with their intervals."""
    scale, inertia = values["coupling"], values["thrust_coefficient"]
    ratio, drag = values["lateral_inertia_ratio"], values["lateral_drag"]
    found = []
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
        slope = np.array([exponents.get(each, 0.0) * value for each in names])
        if "lateral_drag" in exponents and "lateral_drag" in names:  # not fitted as a logarithm
            slope[list(names).index("lateral_drag")] = scale
        error = Z95 * float(np.sqrt(slope @ covariance @ slope)) if identified else np.inf
        found.append(Estimate(name, value, max(0.0, value - error), value + error))
    return tuple(found)


def _headline(
    channels: Sequence[Channel], failed: Sequence[str], identified: bool, inflation: float
) -> str:
    """Return the first line of what is shown."""
    explains = " and ".join(
        f"{_percent(channel.explained_out_of_sample)} of {_SYMBOLS[channel.name]}"
        for channel in channels
    )
    if not failed:
        return f"identified: the model explains {explains}"
    causes = [each for each in failed if each.endswith(" = 0")]
    why = "; ".join(
        words.format(" and ".join(symbols))
        for sign, words in _SIGNS.items()
        if (symbols := [s for name, s in _SYMBOLS.items() if f"{sign} of {name}" in failed])
    )
    if causes:
        why += f"; it looks as if {causes[0].replace(' = 0', ' is not 0')}"
    if not identified:
        return f"not identified: the model explains {explains}: {why}"
    wider = f"intervals are {inflation:.2g} times as wide as noise alone makes them"
    return f"careful: the model lacks something and explains {explains}: {why}; {wider}"


def _percent(share: float) -> str:
    """Return a share with as many digits as tell it from all: 71 %, 99.63 %, 99.9950 %."""
    rest = max(1.0 - share, 1e-6)
    digits = min(4, max(0, -math.floor(math.log10(rest)) - 1))
    return f"{100.0 * max(share, 0.0):.{digits}f} %"


def _covariance(jacobian: Array, innovations: Array) -> tuple[Array, Array | None]:
    """Of the errors in z, and the direction in which these data do not tell z, if there is one.

    Where what is left over is correlated from tick to tick, the error is larger than white noise
    would make it (Newey and West, "A simple, positive semi-definite, heteroskedasticity and
    autocorrelation consistent covariance matrix").
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
    for lag in range(1, misfit.LAGS + 1):
        product = np.einsum("cni,cnj->ij", scores[:, lag:], scores[:, :-lag])
        meat += (1.0 - lag / (misfit.LAGS + 1)) * (product + product.T)
    robust = inverse @ meat @ inverse
    wider = np.sqrt(np.maximum(np.diag(robust) / np.diag(inverse), 1.0))
    unscaled = wider / size
    return inverse * np.outer(unscaled, unscaled), vectors[:, 0] if weak[0] else None


def _wandering(residual: Array) -> float:
    """Half of the 95 % interval of a mean, by how much the means of stretches differ [N].

    Whatever the drift is, as long as a stretch is as good as another (Ibragimov and Müller,
    "t-statistic based correlation and heterogeneity robust inference").
    """
    halves = []
    for count in _STRETCHES:  # a drift whose period is one stretch is seen by the other cut
        means = [stretch.mean() for stretch in np.array_split(residual, count)]
        deviation = np.std(means, ddof=1) / np.sqrt(count)
        halves.append(float(student95(count - 1) * deviation))
    return max(halves)


def _estimate(name: str, value: float, spread: dict[str, float]) -> Estimate:
    error = spread.get(name)
    if error is None:
        return Estimate(name, value, value, value, fitted=False)
    if name in LOGARITHMIC:  # a share, and so the interval is not symmetric
        high = value * float(np.exp(min(error, _UNKNOWN))) if np.isfinite(error) else np.inf
        return Estimate(name, value, value * float(np.exp(-error)), high)
    low = value - error if name in SIGNED else max(0.0, value - error)
    return Estimate(name, value, low, value + error)


def _smoothed(residual: Array, tick: float) -> Array:
    width = min(max(1, round(_SMOOTH / tick)), residual.shape[1])
    smoothed: Array = uniform_filter1d(residual, width, axis=1, mode="nearest")
    return smoothed


def _series(problem: Problem, values: dict[str, float], drifts: Sequence[Array]) -> Fit:
    gap = np.full((1,), np.nan)
    gaps = np.full((2, 1), np.nan)

    def joined(parts: Sequence[Array]) -> Array:
        between = gap if parts[0].ndim == 1 else gaps
        pieces = [piece for part in parts for piece in (part, between)][:-1]
        return np.concatenate(pieces, axis=-1)

    forces = problem.forces(values)
    return Fit(*map(joined, (problem.times, problem.measured, forces, drifts)))


def _remarks(
    names: Sequence[str], estimates: Sequence[Estimate], untold: Array | None
) -> tuple[str, ...]:
    remarks = []
    if untold is not None:
        involved = [name for name, part in zip(names, untold, strict=True) if abs(part) > 0.3]
        remarks.append(
            f"these data do not tell {' and '.join(involved)}"
            + (" apart" if len(involved) > 1 else "")
            + "; fix one, or run fishctl identify --experiment"
        )
    wide = [e.name for e in estimates if e.name in names and _is_wide(e)]
    if wide:
        remarks.append(f"known to 10 % at best: {', '.join(wide)}")
    ends = [
        f"{name} = {value:.4g}"
        for name, value in ((e.name, e.value) for e in estimates if e.name in BOUNDS)
        if misfit.at_end(name, value)
    ]
    if ends:
        remarks.append(f"at the end of where a fit looks: {', '.join(ends)}")
    return tuple(remarks)


def _is_wide(estimate: Estimate) -> bool:
    """Return whether the interval is wider than ±10 % of the value, and ±1 ms or ±1 mrad."""
    low, high = estimate.known
    if not estimate.fitted or not math.isfinite(high):
        return False
    if estimate.name in LOGARITHMIC:
        return high > 1.2 * low
    smallest = _SMALLEST.get(estimate.name)
    return smallest is not None and high - low > max(0.2 * estimate.value, smallest)
