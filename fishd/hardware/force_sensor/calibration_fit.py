"""Fit of the force sensor's calibration to known loads; for `fishctl calibrate force`.

Force = C·[V_x, V_y, 1], least squares over the loads. The covariance of the gains follows from the
residuals of the fit, and from the error that all loads share, which causes no residuals.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.core.calibration import Covariance, ForceCalibration
from fishd.core.errors import FishdError

MIN_LOADS = 5
"""Smallest number of loads for a fit."""
MAX_CONDITION = 100.0
"""Largest condition number of a fit; beyond it, one direction is known too badly."""
MAX_RESIDUAL_FRACTION = 0.2
"""Largest residual of a fit, as a fraction of the loads, both as root mean squares.

Voltages unrelated to the loads leave about 0.7 with five loads, and less than 0.2 in fewer than one
case of five hundred. The worst usable sensors leave 0.02.
"""
_ERROR_FLOOR_FRACTION = 0.1
"""A small load is assumed to have at least the error of this fraction of the largest load."""
_FREEDOM = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 20.0, 60.0, math.inf)
_STUDENT = (12.706, 6.017, 4.303, 3.182, 2.776, 2.571, 2.447, 2.306, 2.179, 2.086, 2.000, 1.960)
"""Quantile 0.975 of Student's t for each of the degrees of freedom in `_FREEDOM`."""
_MIN_LOAD_FRACTION = 0.01
"""Smallest load that counts as a load along an axis, as a fraction of the largest load."""

_Vectors = NDArray[Any]


class Load(NamedTuple):
    """One load, and the voltages of the sensor under it."""

    fx: float
    """Force on the fish [N]; forward is positive."""
    fy: float
    """Lateral force on the fish [N]; to its left is positive."""
    vx: float
    """Voltage of channel x [V]."""
    vy: float


class Fit(NamedTuple):
    """Calibration fitted to loads, with its error at each load."""

    calibration: ForceCalibration
    errors: list[tuple[float, float]]
    """Residual at each load, fitted minus true force, along x and y [N]."""


class PoorLoads(FishdError, ValueError):
    """Loads that do not determine a calibration; the message says what is missing."""


def fit(loads: Sequence[Load], load_ci95: float = 0.0) -> Fit:
    """Return the calibration that fits the loads best, with the covariance of its gains.

    Its `residual` is the root mean square of all errors [N], its `condition` the ratio of the
    largest to the smallest spread of the voltages.
    load_ci95: half-width of the 95 % confidence interval of the error that all loads share, as a
        fraction
    Raises `PoorLoads`.
    """
    missing = missing_loads([(load.fx, load.fy) for load in loads])
    if missing:
        raise PoorLoads(f"these loads are not enough: {', '.join(missing)}")
    forces = np.array([(load.fx, load.fy) for load in loads])
    voltages = np.array([(load.vx, load.vy) for load in loads])
    if not np.isfinite(voltages).all():
        raise PoorLoads("a voltage is not a finite number; measure that load again")
    condition = _condition(voltages)
    if condition > MAX_CONDITION:
        raise PoorLoads(
            f"the voltages hardly distinguish x from y (condition number {condition:.3g}, at most "
            f"{MAX_CONDITION:g}): {_describe_still_channel(voltages)}"
        )
    # Fitting about the means keeps the digits of a large voltage without a force.
    middle = voltages.mean(axis=0)
    design = np.column_stack([voltages - middle, np.ones(len(loads))])
    solution = np.linalg.lstsq(design, forces, rcond=None)[0]
    gains, offsets = solution[:2], solution[2] - middle @ solution[:2]
    errors = design @ solution - forces
    rows = _covariances(design, forces, errors)
    covariance_x, covariance_y = (
        _with_load_error(row, gains[:, axis], load_ci95) for axis, row in enumerate(rows)
    )
    calibration = ForceCalibration(
        xx=float(gains[0, 0]),
        xy=float(gains[1, 0]),
        x0=float(offsets[0]),
        yx=float(gains[0, 1]),
        yy=float(gains[1, 1]),
        y0=float(offsets[1]),
        loads=len(loads),
        residual=float(np.sqrt(np.mean(errors**2))),
        condition=condition,
        covariance_x=covariance_x,
        covariance_y=covariance_y,
        load_ci95=load_ci95,
    )
    return Fit(calibration, [(float(x), float(y)) for x, y in errors])


def _covariances(design: _Vectors, forces: _Vectors, errors: _Vectors) -> list[_Vectors]:
    """Return the covariance of the two gains of F_x, and of those of F_y, 2 x 2 each [N²/V²].

    The errors of different loads are assumed to be independent. The error of a load along its force
    is proportional to the load (its weight, friction of the pulley), and so is the error across it,
    with another factor (direction of the thread). Both factors are estimated from the residuals of
    F_x and F_y together, and widened by Student's t for their degrees of freedom.
    """
    solver = np.linalg.pinv(design)
    residual_projection = np.eye(len(design)) - design @ solver
    squares = forces**2
    floor = _ERROR_FLOOR_FRACTION**2 * squares.max()
    across = squares[:, ::-1]
    factors = [_factor(residual_projection, errors, shape + floor) for shape in (squares, across)]
    variances = factors[0] * (squares + floor) + factors[1] * across
    return [solver[:2] * variances[:, axis] @ solver[:2].T for axis in (0, 1)]


def _factor(residual_projection: _Vectors, errors: _Vectors, shape: _Vectors) -> float:
    """Return what to multiply `shape` by for the variances of these errors, widened by Student's t.

    residual_projection: projection of the errors of the loads on the residuals of the fit
    shape: variance of the error of each load, along x and y, up to that factor
    """
    weight = shape / shape.max()
    modes = []
    for axis in (0, 1):
        spread = residual_projection * np.sqrt(shape[:, axis])
        modes.append(np.linalg.eigvalsh(spread.T @ (weight[:, axis, np.newaxis] * spread)))
    expected = np.concatenate(modes)
    freedom = expected.sum() ** 2 / (expected**2).sum()
    widening = student95(freedom) / 1.96
    return float((weight * errors**2).sum() / expected.sum() * widening**2)


def student95(freedom: float) -> float:
    """Return the half-width of a 95 % interval, in standard errors, by Student's t.

    freedom: degrees of freedom. `fishd.lab.statistics` has it exactly, but needs SciPy.
    """
    quantile = np.interp(-1.0 / max(freedom, 1.0), -1.0 / np.array(_FREEDOM), np.log(_STUDENT))
    return float(np.exp(quantile))


def _with_load_error(covariance: _Vectors, gains: _Vectors, load_ci95: float) -> Covariance:
    """Return variance, covariance and variance of two gains, with the error that all loads share.

    That error multiplies all gains by the same number.
    """
    total = covariance + (load_ci95 / 1.96) ** 2 * np.outer(gains, gains)
    return float(total[0, 0]), float(total[0, 1]), float(total[1, 1])


def check(fitted: Fit, loads: Sequence[Load], names: Sequence[str]) -> None:
    """Raise `PoorLoads`, which names the worst load, if the residual of the fit is too large."""
    size = math.sqrt(sum(load.fx**2 + load.fy**2 for load in loads) / (2 * len(loads)))
    residual = fitted.calibration.residual
    if residual > MAX_RESIDUAL_FRACTION * size:
        raise PoorLoads(
            f"the voltages do not follow the loads: the residual is {residual / size:.0%} of them "
            f"(rms), and may be {MAX_RESIDUAL_FRACTION:.0%} at most; measure "
            f"{worst_load(fitted, names)} again first"
        )


def worst_load(fitted: Fit, names: Sequence[str]) -> str:
    """Return the name of the load with the largest error."""
    sizes = [math.hypot(*error) for error in fitted.errors]
    return names[sizes.index(max(sizes))]


def missing_loads(forces: Sequence[tuple[float, float]]) -> list[str]:
    """Return what these loads (F_x, F_y) [N] lack for a calibration; empty if they suffice."""
    if not all(math.isfinite(f) for force in forces for f in force):
        return ["every load must be a finite number"]
    largest = max((math.hypot(*force) for force in forces), default=0.0)
    least = _MIN_LOAD_FRACTION * largest
    present = {
        "no load at all (zero)": any(math.hypot(*force) < least for force in forces),
        "a load along +x": any(fx > least for fx, _ in forces),
        "a load along -x": any(fx < -least for fx, _ in forces),
        "a load along +y": any(fy > least for _, fy in forces),
        "a load along -y": any(fy < -least for _, fy in forces),
    }
    if largest == 0.0:
        present["no load at all (zero)"] = bool(forces)
    missing = [f"{name} is missing" for name, is_present in present.items() if not is_present]
    if not missing and _condition(np.array(forces)) > MAX_CONDITION:
        missing.append("all loads are on one line; a load across it is missing")
    if not missing and len(forces) < MIN_LOADS:
        missing.append(f"{MIN_LOADS} loads are needed, there are {len(forces)}")
    return missing


def _condition(vectors: _Vectors) -> float:
    """Return the ratio of the largest to the smallest spread of points; infinite on a line."""
    widths = np.linalg.svd(vectors - vectors.mean(axis=0), compute_uv=False)
    return float(widths[0] / widths[-1]) if widths[-1] > 0.0 else math.inf


def _describe_still_channel(voltages: _Vectors) -> str:
    """Return a sentence that says which channel hardly moves."""
    spread = np.ptp(voltages, axis=0)
    for channel, other_channel, name in ((0, 1, "x"), (1, 0, "y")):
        if spread[channel] < spread[other_channel] / MAX_CONDITION:
            return (
                f"V_{name} moved by {spread[channel] * 1e3:.3g} mV only; is the sensor wired to "
                f"force_sensor.channel_{name}?"
            )
    return "both channels moved together; were loads along x and along y hung as planned?"
