"""Fin angles of a camera as a third output of an identification: they separate K, λ, K_y and K_d.

The forces enter as the values of their fit and the covariance of these. The fin angles are added by
an iterated Kalman update (Bell and Cathey, "The iterated Kalman filter update as a Gauss-Newton
method"), with the delay and the zero of the camera free and its scale nearly known. The factor that
forces do not determine, K_y/K, thereby becomes known as well as that scale.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from fishd.lab.identification.fit import BOUNDS, DRIVE, LOGARITHMIC, STEPS, Problem
from fishd.lab.identification.passages import Unidentifiable
from fishd.lab.identification.response import Array, Motion
from fishd.lab.identification.result import Estimate, FinAngleFit, Identification
from fishd.lab.identification.summary import SCALED, make_estimate, make_products
from fishd.lab.statistics import Z95

if TYPE_CHECKING:
    from pandas import DataFrame

RATIO = "lateral_inertia_ratio"
CAMERA = ("camera_delay", "fin_angle_zero", "fin_angle_scale")
"""Parameters of the camera."""
MIN_READINGS = 200
"""Smallest number of known fin angles."""
MIN_SWING_RAD = 0.03
"""Smallest range of the fin angle of a fish that swings [rad]."""
MIN_AGREEMENT = 0.5
"""Smallest share of the variance of the fin angle that φ_c must explain."""
_DELAYS_S = np.arange(-0.15, 0.5, 0.004)
"""Delays of the camera that are compared before the fit [s]."""
_MIN_ERROR_RAD = 5e-4
"""Smallest standard error of a fin angle, for one without a stated uncertainty [rad]."""
_DELAY_SPREAD_S, _ZERO_SPREAD_RAD, _FREE_SPREAD = 0.5, 1.0, 3.0
"""Standard deviations before the update of what is not known then: delay and zero of the camera,
and K_y/K as a logarithm."""
_BLOCK_S = 2.0
"""Length of blocks of fin angles beyond which their errors, such as those by waves, are
independent [s]."""
_MAX_STEPS = 8
"""Largest number of steps of the update."""
_OUTLIER = 5.0
"""Deviation of a fin angle that is left out, in standard errors or in those of all residuals."""
_MAX_LEFT_OUT = 0.02
"""Largest share of such fin angles without a warning."""
_MAX_DISAGREEMENT = 4.0
"""Largest change of a parameter by the fin angles without a warning, in standard errors of the
change, or 0.3 of those of the fit to the forces if that is larger."""
_MAX_NOISE_RATIO = 2.0
"""Largest residual without a warning, relative to the stated uncertainty."""


class FinAngles(NamedTuple):
    """Known fin angles of several runs, in arrays of equal length."""

    times: Array
    """Times since the first tick of all, those of passages [s]."""
    angles: Array
    """[rad]"""
    errors: Array
    """Standard errors [rad]."""
    unknown: str
    """Most frequent reason why others are unknown; empty if none are."""


def collect_fin_angles(runs: Sequence[Any], tables: "Sequence[DataFrame]") -> FinAngles:
    """Return the fin angles of recordings, or of the columns `fin_angle` of tables.

    tables: the ticks of the same runs
    Raises `Unidentifiable` for a run that has none.
    """
    parts, reasons, begin = [], Counter[str](), 0.0
    for run, table in zip(runs, tables, strict=True):
        if len(table) < 2:
            continue
        clock = table["time"].to_numpy(float)
        elapsed = table["elapsed"].to_numpy(float) if "elapsed" in table else clock
        if tails := getattr(run, "tails", None):
            known = [(r.time, r.alpha, r.uncertainty or 0.0) for r in tails if r.alpha is not None]
            reasons.update(r.reason for r in tails if r.alpha is None)
            rows = np.array(known).reshape(-1, 3)
            rows = rows[(rows[:, 0] >= clock[0]) & (rows[:, 0] <= clock[-1])]
            rows[:, 0] = np.interp(rows[:, 0], clock, elapsed)
        elif "fin_angle" in table:
            error = table.get("fin_angle_uncertainty", 0.0)
            columns = table.assign(e=elapsed, u=error)[["e", "fin_angle", "u"]]
            rows = columns.dropna(subset="fin_angle").fillna(0.0).to_numpy(float)
        else:
            name = getattr(run, "path", "this table")
            raise Unidentifiable(
                f"{name}: it has no fin angles; record the fish with --camera while fishd-camera "
                "measures, or leave --tail out"
            )
        rows[:, 0] += begin - elapsed[0]
        parts.append(rows)
        begin += float(elapsed[-1] - elapsed[0])
    times, angles, errors = np.concatenate([*parts, np.empty((0, 3))]).T
    unknown = reasons.most_common(1)[0][0] if reasons else ""
    return FinAngles(times, angles, np.maximum(errors / Z95, _MIN_ERROR_RAD), unknown)


class _Camera:
    """Fin angles within passages, and their prediction by a fish.

    Attributes:
        names: names of the fitted parameters of the fish.
        start: values before an update, as in `_Update`.
        times, angles, errors: fin angles, their times [s] and standard errors [rad].
        sign: -1 for a mirrored picture, whose angles have been mirrored again; else 1.
        blocks: begins of blocks of fin angles whose errors are independent.
    """

    def __init__(self, problem: Problem, values: dict[str, float], fin: FinAngles) -> None:
        """Raises `Unidentifiable` where they are too few, do not swing, or do not follow φ_c."""
        self._problem, self._values, self.names = problem, values, problem.names
        self._times, indices = [], []
        for passage in problem.passages:
            since = fin.times - np.median(passage.times - passage.ends[1:] * passage.tick)
            inside = np.flatnonzero((since >= problem.settle) & (since <= passage.duration))
            self._times.append(since[inside])
            indices.append(inside)
        kept = np.concatenate(indices)
        if len(kept) < MIN_READINGS:
            why = f"; most are unknown because: {fin.unknown}" if fin.unknown else ""
            raise Unidentifiable(
                f"{len(kept)} fin angles are known while the fish swims: {MIN_READINGS} or more "
                f"are needed{why}"
            )
        swing = float(np.ptp(np.quantile(fin.angles[kept], [0.02, 0.98])))
        if swing < MIN_SWING_RAD:
            raise Unidentifiable(
                f"the fin angle changes by {swing * 1e3:.0f} mrad only: a recording of a fish that "
                "swings is needed"
            )
        delay, zero, self.sign = self._find_start(fin.angles[kept])
        self.times = fin.times[kept]
        self.angles, self.errors = self.sign * fin.angles[kept], fin.errors[kept]
        self.start = np.concatenate((problem.to_z(values), (delay, self.sign * zero, 0.0)))
        numbers = np.floor(np.concatenate(self._times) / _BLOCK_S)
        self.blocks = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist()]

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Return the fin angles [rad] for values x, and their derivatives, (n, values)."""
        count = len(self.names)
        swing = self._swing(x)
        slopes = np.ones((len(swing), len(x)))
        for index, name in enumerate((*self.names, CAMERA[0])):
            step = STEPS.get(name, 1e-4)
            is_used = name in (*DRIVE, "coupling", CAMERA[0])
            later = self._swing(x + step * np.eye(len(x))[index]) if is_used else swing
            slopes[:, index] = (later - swing) / step
        slopes[:, -1] = swing
        return swing + x[count + 1], slopes

    def _swing(self, x: Array) -> Array:
        """Return the fin angles without the zero [rad]."""
        fish = self._problem.to_values(x[: len(self.names)], self._values)
        angles = self._follow(self._problem.motions(fish), x[-3])
        swing: Array = fish["coupling"] * np.exp(x[-1]) * angles
        return swing

    def _follow(self, motions: Sequence[Motion], delay: float) -> Array:
        """Return the fin angles of motions for λ = 1 [rad]; delay: of the camera [s]."""
        pairs = zip(motions, self._times, strict=True)
        return np.concatenate([motion.fin_angles(times - delay) for motion, times in pairs])

    def _find_start(self, angles: Array) -> tuple[float, float, float]:
        """Return delay [s], zero [rad] and sign of the best agreement with the forces' fish."""
        motions = self._problem.motions(self._values)
        fits = []
        for delay in _DELAYS_S.tolist():
            model = self._follow(motions, delay)
            (own, common), (_, whole) = np.cov(model, angles).tolist()
            zero = float(angles.mean() - common / own * model.mean())
            fits.append((common**2 / own / whole, delay, zero, math.copysign(1.0, common)))
        agreement, delay, zero, sign = max(fits)
        if agreement < MIN_AGREEMENT:
            raise Unidentifiable(
                f"the fin angle does not follow φ_c: {agreement:.0%} of it agree with the forces; "
                "does the camera see this fish, and has it the clock of its fishd?"
            )
        return delay, zero, sign


def add_fin_angles(
    identification: Identification,
    problem: Problem,
    values: dict[str, float],
    fin: FinAngles,
    scale_ci95: float,
    *,
    scale_is_free: bool,
) -> Identification:
    """Return an identification from forces with fin angles added.

    problem, values: the fit to the forces, and all its values
    scale_ci95: half-width of the 95 % interval of the scale of the fin angles, whose middle is 1
    scale_is_free: whether K_y/K affects no force
    Raises `Unidentifiable`.
    """
    camera = _Camera(problem, values, fin)
    if not identification.identified:
        why = "the fin angles are not used, as the forces are not explained"
        return replace(identification, remarks=(*identification.remarks, why))
    scale_error = scale_ci95 / Z95
    free = np.diag(
        [_DELAY_SPREAD_S, _ZERO_SPREAD_RAD, _FREE_SPREAD if scale_is_free else scale_error]
    )
    prior = block_diag(identification.covariance, free**2)
    update = _update(camera, prior)
    x, covariance = update.x, update.covariance
    if scale_is_free:
        covariance[-1, -1] += scale_error**2
    residual = update.residual[update.kept]
    fit = FinAngleFit(
        estimates=tuple(
            Estimate(name, value, value - half_width, value + half_width)
            for name, value, half_width in zip(
                CAMERA[:2] if scale_is_free else CAMERA,
                (float(x[-3]), camera.sign * float(x[-2]), float(np.exp(x[-1]))),
                (Z95 * np.sqrt(np.diag(covariance)[-3:])).tolist(),
                strict=False,
            )
        ),
        explained=float(1.0 - np.var(residual) / np.var(camera.angles)),
        noise=float(np.sqrt(np.mean(residual**2))),
        used=len(residual),
        left_out=len(camera.angles) - len(residual),
        times=camera.times,
        measured=camera.angles,
        simulated=camera.angles - update.residual,
    )
    change = np.sqrt(np.maximum(np.diag(prior) - np.diag(covariance), 0.1 * np.diag(prior)))
    changes = np.delete(np.abs(x - camera.start) / change, [len(x) - 3, len(x) - 2])
    doubtful = np.flatnonzero(changes > _MAX_DISAGREEMENT)
    names = [(*problem.names, CAMERA[2])[index] for index in doubtful]
    identification = replace(
        identification,
        remarks=(*identification.remarks, *_remarks(fit, update.noise, camera.sign, names)),
        fin_angle=fit,
    )
    return _with_values(identification, problem, values, x, covariance, scale_is_free)


class _Update(NamedTuple):
    """Result of an update, and what is left of the fin angles."""

    x: Array
    """Fitted parameters as in a `Problem`; delay [s], zero [rad] and log scale of the camera."""
    covariance: Array
    residual: Array
    """Measured minus predicted, of all fin angles [rad]."""
    kept: NDArray[np.bool_]
    """Which of them are used."""
    noise: float
    """Rms of the residual, relative to the stated errors; at least 1."""


def _update(camera: _Camera, prior: Array) -> _Update:
    """Return the most likely values; prior: covariance of the values before."""
    x = start = camera.start
    for _ in range(_MAX_STEPS):
        predicted, slopes = camera.predict(x)
        residual = camera.angles - predicted
        ratio = residual / camera.errors
        typical = max(1.0, 1.4826 * float(np.median(np.abs(ratio))))
        kept = np.abs(ratio) <= _OUTLIER * typical
        noise = max(1.0, float(np.sqrt(np.mean(ratio[kept] ** 2))))
        weighted = slopes * (kept / (noise * camera.errors) ** 2)[:, None]
        gain = np.linalg.inv(np.eye(len(x)) + prior @ (weighted.T @ slopes))
        covariance = gain @ prior
        before, x = x, start + covariance @ (weighted.T @ (residual + slopes @ (x - start)))
        x = _keep_in_bounds(camera.names, x, covariance)
        if np.all(np.abs(x - before) <= 0.02 * np.sqrt(np.diag(covariance))):
            break
    # Errors of waves are correlated: as in `misfit_covariance`, with blocks as clusters.
    scores = np.add.reduceat(weighted * residual[:, None], camera.blocks, axis=0)
    robust = gain @ prior @ gain.T + covariance @ (scores.T @ scores) @ covariance
    wider = np.sqrt(np.maximum(np.diag(robust) / np.maximum(np.diag(covariance), 1e-300), 1.0))
    return _Update(x, covariance * np.outer(wider, wider), residual, kept, noise)


def _keep_in_bounds(names: Sequence[str], x: Array, covariance: Array) -> Array:
    """Return the most likely values of which none is below its bound."""
    lowest = np.full(len(x), -np.inf)
    lowest[: len(names)] = [-np.inf if n in LOGARITHMIC else BOUNDS[n][0] for n in names]
    for index in np.flatnonzero(x < lowest):
        x = x + covariance[:, index] * ((lowest[index] - x[index]) / covariance[index, index])
    within: Array = np.maximum(x, lowest)
    return within


def _remarks(fit: FinAngleFit, noise: float, sign: float, names: Sequence[str]) -> Iterator[str]:
    """Yield warnings about the fin angles; names: parameters that they change too much."""
    if sign < 0.0:
        yield "the picture shows the tail mirrored: the sign of fin angles was changed"
    if noise > _MAX_NOISE_RATIO:
        yield (
            f"the fin angle deviates from the fish by {fit.noise * 1e3:.1f} mrad, {noise:.2g} "
            "times its stated uncertainty"
        )
    if fit.left_out > _MAX_LEFT_OUT * (fit.used + fit.left_out):
        yield f"{fit.left_out} of {fit.used + fit.left_out} fin angles are left out"
    if names:
        yield f"forces and fin angles disagree on {', '.join(names)}"


def _with_values(
    identification: Identification,
    problem: Problem,
    values: dict[str, float],
    x: Array,
    covariance: Array,
    scale_is_free: bool,
) -> Identification:
    """Return the identification with other values; x, covariance: those of the update."""
    count, growth = len(problem.names), float(np.exp(x[-1]))
    names = (*problem.names, RATIO) if scale_is_free else problem.names
    exponents = SCALED if scale_is_free else {}
    all_values = problem.to_values(x[:count], values)
    all_values |= {name: all_values[name] * growth**power for name, power in exponents.items()}
    turn = np.zeros((len(names), len(x)))
    for row, name in enumerate(names):
        power, is_log = exponents.get(name, 0.0), name in LOGARITHMIC
        if row < count:
            turn[row, row] = 1.0 if is_log else growth**power
        turn[row, -1] = power * (1.0 if is_log else all_values[name])
    covariance = turn @ covariance @ turn.T
    widths = dict(zip(names, (Z95 * np.sqrt(np.diag(covariance))).tolist(), strict=True))
    scale = "; the fin angles determine λ, K, K_y and K_d" if scale_is_free else ""
    return replace(
        identification,
        headline=identification.headline + scale,
        estimates=tuple(
            make_estimate(e.name, all_values[e.name], widths) if e.name in widths else e
            for e in identification.estimates
        ),
        products=make_products(names, all_values, covariance, True),
        names=names,
        covariance=covariance,
    )
