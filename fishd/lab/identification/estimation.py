"""From ticks to a fish: starts, fits, intervals, and what is to be said about them."""

import os
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2, t

from fishd.core import text
from fishd.core.errors import ParameterError
from fishd.core.schema import nearest
from fishd.lab.identification.fit import BOUNDS, DRIVE, FORCES, LOGARITHMIC, Problem, solve
from fishd.lab.identification.passages import SHORTEST, Passage, Unidentifiable, passages
from fishd.lab.identification.response import Array
from fishd.lab.identification.result import (
    UNITS,
    UNKNOWN_TO_FITS,
    Channel,
    Estimate,
    Fit,
    Identification,
)
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

if TYPE_CHECKING:
    from pandas import DataFrame

DEFAULT = tuple(name for name in (*DRIVE, *FORCES) if name != "servo_reaction")
"""What is fitted unless something else is asked for."""
POSSIBLE = tuple(BOUNDS)

_Z = 1.96
_SETTLE = 2.0
"""How long the beginning of a passage is not judged, since nobody knows what was before [s]."""
_LONGEST_SETTLE = 20.0
_FORGOTTEN = 7.0
"""Time constants of the fin after which its start is forgotten."""
_ROUGH = 12
"""Steps of a fit that shows whether it is worth going on."""
_STARTS = tuple(product((1.0, 0.5, 2.0), (0.01, 0.06, 0.12)))
"""Natural frequency, as a multiple of that of the first fish, and delay [s]."""
_UNKNOWN = 50.0
"""Error of a logarithm that says nothing any more."""
_SMOOTH = 5.0
"""For the drift that is shown [s]."""
_SINGULAR = 1e-10
"""Information below this share of the largest is none."""
SIGNED = ("servo_reaction", "rotation")
"""These may be negative."""
OFFSETS = ("offset_x", "offset_y")
_STRETCHES = (4, 5)
"""Into how many stretches runs are cut, whose means tell how well the mean of a drift is known."""
_LAGS = 20
"""Ticks that what is left over may be correlated for."""


def identify(
    runs: "DataFrame | str | os.PathLike[str] | Sequence[DataFrame | str | os.PathLike[str]]",
    *,
    start: PlantParameters | None = None,
    rig: SimulationSettings | None = None,
    fit: Sequence[str] = DEFAULT,
) -> Identification:
    """Fit a fish and its rig to what some runs of it have measured.

    runs: tables of ticks (`fishd.recording.read`, `experiment`), or paths of recordings
    start: where to begin, and the value of what is not fitted; by default the fish of Fu et al.
    rig: the same for `rotation`; by default the sensor is not turned
    fit: what to fit: keys of section `plant` among `POSSIBLE`, and `rotation`

    Raises `Unidentifiable` for runs that hold nothing to fit, `ParameterError` for a name in `fit`
    that is not possible, and what `fishd.recording.read` raises.
    """
    names = check(fit)
    parts = passages([_table(run) for run in _several(runs)])
    if not any(one.commands.any() for one in parts):
        raise Unidentifiable("φ_c is zero all the time: a recording of a fish that swims is needed")
    known = msgspec.structs.asdict(start or PlantParameters())
    known["rotation"] = (rig or SimulationSettings()).rotation
    values = {name: float(known[name]) for name in POSSIBLE}
    problem, values = _solved(parts, names, values)
    settle = _settling(values)
    if settle > _SETTLE:
        longer = [one for one in parts if one.duration > settle + SHORTEST]
        parts, settle = (longer, settle) if longer else (parts, _SETTLE)
        problem = Problem(parts, names, settle)
        values = solve(problem, values)
    return _summary(parts, problem, values, known)


def _several(runs: object) -> list[object]:
    is_list = isinstance(runs, Sequence) and not isinstance(runs, str)
    return list(runs) if is_list else [runs]  # type: ignore[call-overload]


def _table(run: object) -> "DataFrame":
    if isinstance(run, str | os.PathLike):
        from fishd.recording import open_run

        recorded = open_run(run)
        unit = recorded.summary.force_unit
        if unit != "N":
            raise Unidentifiable(
                f"{recorded.path}: its forces are in {text.quoted(unit)}, not in "
                "newtons: the force sensor was not calibrated; calibrate it by 'fishctl calibrate "
                "force', and record it again"
            )
        return recorded.frame()
    return run  # type: ignore[return-value]


def check(fit: Sequence[str]) -> tuple[str, ...]:
    """Names of what to fit, in order; raises ParameterError for one that is not possible."""
    for name in fit:
        if name not in POSSIBLE:
            raise ParameterError(f"'{name}' cannot be fitted; {nearest(name, list(POSSIBLE))}")
    if not fit:
        raise ParameterError(f"nothing to fit; possible: {', '.join(POSSIBLE)}")
    return tuple(name for name in POSSIBLE if name in fit)


def _solved(
    parts: Sequence[Passage], names: tuple[str, ...], first: dict[str, float]
) -> tuple[Problem, dict[str, float]]:
    """The best fit of several starts; of one, where it leaves no more than noise.

    The others are fitted roughly, and the best of them to its end.
    """
    starts = [_begun(first, names, *start) for start in _STARTS]
    problem = Problem(parts, names, _SETTLE)
    values = solve(problem, starts[0])
    if all(map(_is_white, problem.whitened(problem.residuals(values)))):
        return problem, values
    rough = []
    for start in starts[1:]:
        other = Problem(parts, names, _SETTLE)
        rough.append((solve(other, start, rounds=1, steps=_ROUGH), other))
    best, other = min(rough, key=lambda each: each[1].unexplained)
    best = solve(other, best)
    return (other, best) if other.unexplained < problem.unexplained else (problem, values)


def _begun(
    first: dict[str, float], names: tuple[str, ...], frequency: float, delay: float
) -> dict[str, float]:
    """Where a fit begins; away from zero, where backlash has no slope."""
    begun = dict(first)
    for name, value in (
        ("omega0", first["omega0"] * frequency),
        ("servo_delay", max(first["servo_delay"], delay)),
        ("backlash", max(first["backlash"], 0.01)),
    ):
        if name in names:
            begun[name] = value
    return begun


def _settling(values: dict[str, float]) -> float:
    """How long the fin remembers where it was [s]."""
    omega0, xi = values["omega0"], values["xi"]
    slowest = 0.5 * omega0 * (xi - np.sqrt(max(0.0, xi * xi - 4.0)))
    return float(min(_FORGOTTEN / slowest, _LONGEST_SETTLE))


def _summary(
    parts: Sequence[Passage],
    problem: Problem,
    values: dict[str, float],
    known: dict[str, float],
) -> Identification:
    """What is found; `known` holds what the model does not use, too."""
    all_values = {**known, **values}
    residuals = problem.residuals(values)
    innovations = problem.whitened(residuals)
    jacobian = problem.jacobian(values)
    covariance, untold = _covariance(jacobian, innovations)
    deviations = np.sqrt(np.diag(covariance))
    spread = dict(zip(problem.names, (_Z * deviations).tolist(), strict=True))
    estimates = [_estimate(name, all_values[name], spread) for name in UNITS if name in all_values]
    left = np.concatenate(residuals, axis=1)
    slopes = problem.slopes_of_means(values)
    for name, of, slope, noise in zip(OFFSETS, left, slopes, problem.noise, strict=True):
        told = _Z * np.sqrt(slope @ covariance @ slope + noise.white**2 / of.size)
        error = float(np.hypot(told, _wandering(of)))
        mean = float(of.mean())
        estimates.append(Estimate(name, mean, mean - error, mean + error))
    drifts = [_smoothed(each, parts[0].tick) for each in residuals]
    channels = tuple(
        Channel(
            name,
            explained=share,
            noise=noise.white,
            drift=float(max(d[k].max() for d in drifts) - min(d[k].min() for d in drifts)),
            white=_is_white(innovations[k]),
        )
        for k, (name, share, noise) in enumerate(
            zip(("fx", "fy"), _explained(problem, residuals), problem.noise, strict=True)
        )
    )
    return Identification(
        estimates=tuple(estimates),
        channels=(channels[0], channels[1]),
        seconds=sum(one.duration for one in parts),
        passages=len(parts),
        remarks=_remarks(problem.names, estimates, channels, untold),
        names=problem.names,
        correlation=covariance / np.outer(deviations, deviations),
        fit=_series(problem, values, drifts),
    )


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
    for lag in range(1, _LAGS + 1):
        product = np.einsum("cni,cnj->ij", scores[:, lag:], scores[:, :-lag])
        meat += (1.0 - lag / (_LAGS + 1)) * (product + product.T)
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
        halves.append(float(t.ppf(0.975, count - 1) * deviation))
    return max(halves)


def _estimate(name: str, value: float, spread: dict[str, float]) -> Estimate:
    error = spread.get(name)
    if error is None:
        return Estimate(name, value, value, value, fitted=False)
    if name in LOGARITHMIC:  # a share, and so the interval is not symmetric
        error = min(error, _UNKNOWN)
        return Estimate(name, value, value * float(np.exp(-error)), value * float(np.exp(error)))
    low = value - error if name in SIGNED else max(0.0, value - error)
    return Estimate(name, value, low, value + error)


def _explained(problem: Problem, residuals: Sequence[Array]) -> list[float]:
    """Share of the variance of each force that a model explains, drift left out."""
    measured, left = problem.whitened(problem.measured), problem.whitened(residuals)
    return [float(1.0 - np.sum(b * b) / np.sum(a * a)) for a, b in zip(measured, left, strict=True)]


def _is_white(innovations: Array) -> bool:
    """The test of Ljung and Box, at one in a thousand."""
    count = len(innovations)
    squares = float(innovations @ innovations)
    lags = range(1, min(_LAGS, count - 1) + 1)
    correlations = [float(innovations[lag:] @ innovations[:-lag]) / squares for lag in lags]
    total = sum(r * r / (count - lag) for lag, r in zip(lags, correlations, strict=True))
    return bool(chi2.sf(count * (count + 2) * total, len(correlations)) > 1e-3)


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
    names: Sequence[str],
    estimates: Sequence[Estimate],
    channels: Sequence[Channel],
    untold: Array | None,
) -> tuple[str, ...]:
    remarks = []
    unfitted = [e.name for e in estimates if e.name in UNKNOWN_TO_FITS and e.value]
    for name in unfitted:
        remarks.append(f"{name} is as in the configuration, but no fit takes it into account")
    if untold is not None:
        involved = [name for name, part in zip(names, untold, strict=True) if abs(part) > 0.3]
        remarks.append(
            f"these data do not tell {' and '.join(involved)}"
            + (" apart" if len(involved) > 1 else "")
            + "; fix one, or run fishctl identify --experiment"
        )
    wide = [
        e.name for e in estimates if e.fitted and e.name in LOGARITHMIC and e.high > 1.2 * e.low
    ]
    if wide:
        remarks.append(f"known to 10 % at best: {', '.join(wide)}")
    ends = [
        f"{name} = {value:.4g}"
        for name, value in ((e.name, e.value) for e in estimates if e.name in BOUNDS)
        if _at_end(name, value)
    ]
    if ends:
        remarks.append(f"at the end of where a fit looks: {', '.join(ends)}")
    symbols = {"fx": "F_x", "fy": "F_y"}
    coloured = [symbols[channel.name] for channel in channels if not channel.white]
    if coloured:
        remarks.append(
            f"what is left of {' and '.join(coloured)} is more than noise: the model lacks "
            "something of this fish, and intervals may be too narrow"
        )
    return tuple(remarks)


def _at_end(name: str, value: float) -> bool:
    low, high = BOUNDS[name]
    if name in LOGARITHMIC:
        return value < 1.001 * low or value > 0.999 * high
    return value >= 0.999 * high or (name in SIGNED and value <= 0.999 * low)
