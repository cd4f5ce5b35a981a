"""From known loads on the force sensor to its calibration; for `fishctl calibrate force`.

Force = C·[V_x, V_y, 1], least squares over the loads. The covariance of the gains follows from what
the fit leaves over, and from the error that all loads share, which leaves nothing over.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.core.calibration import Covariance, ForceCalibration
from fishd.core.errors import FishdError

FEWEST_LOADS = 5
WORST_CONDITION = 100.0
"""Beyond this one direction is known so much worse than the other that the fit is refused."""
WORST_RESIDUAL = 0.2
"""A residual beyond this share of the loads, both as root mean squares, is no fit.

Voltages that have nothing to do with the loads leave about 0.7 with five of them; less than 0.2 is
then rarer than one in five hundred. The worst sensors that are of use leave 0.02.
"""
_FLOOR = 0.1
"""A small load is taken to have at least the error of this fraction of the largest load."""
_FREEDOM = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 20.0, 60.0, math.inf)
_STUDENT = (12.706, 6.017, 4.303, 3.182, 2.776, 2.571, 2.447, 2.306, 2.179, 2.086, 2.000, 1.960)
"""Quantile 0.975 of Student's t for each of these degrees of freedom."""
_NOTICEABLE = 0.01
"""A load counts as one along an axis from this share of the largest load on."""

_Vectors = NDArray[Any]


class Load(NamedTuple):
    """One load, and what the sensor said under it."""

    fx: float
    """Force on the fish [N]; forward is positive."""
    fy: float
    """To the fish's left is positive [N]."""
    vx: float
    """[V]"""
    vy: float


class Fit(NamedTuple):
    """A calibration, and how well it suits the loads that it comes from."""

    calibration: ForceCalibration
    errors: list[tuple[float, float]]
    """What it leaves over at each load, fitted less true, along x and y [N]."""


class PoorLoads(FishdError, ValueError):
    """These loads do not determine a calibration; the message says what is missing."""


def fit(loads: Sequence[Load], load_error: float = 0.0) -> Fit:
    """Return the calibration that suits the loads best, with the covariance of its gains.

    Its `residual` is the root mean square of all errors [N], its `condition` the ratio of the
    largest to the smallest spread of the voltages.
    load_error: half-width of the 95 % interval of the error that all loads share, as a fraction
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
    if condition > WORST_CONDITION:
        raise PoorLoads(
            f"the voltages hardly tell x from y (condition number {condition:.3g}, at most "
            f"{WORST_CONDITION:g}): {_dull(voltages)}"
        )
    # About their means, so that a large voltage without a force costs no digits.
    middle = voltages.mean(axis=0)
    design = np.column_stack([voltages - middle, np.ones(len(loads))])
    solution = np.linalg.lstsq(design, forces, rcond=None)[0]
    gains, offsets = solution[:2], solution[2] - middle @ solution[:2]
    errors = design @ solution - forces
    rows = _covariances(design, forces, errors)
    covariance_x, covariance_y = (
        _with_load_error(row, gains[:, axis], load_error) for axis, row in enumerate(rows)
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
        load_error=load_error,
    )
    return Fit(calibration, [(float(x), float(y)) for x, y in errors])


def _covariances(design: _Vectors, forces: _Vectors, errors: _Vectors) -> list[_Vectors]:
    """Return the covariance of the two gains of F_x, and of those of F_y, 2 x 2 each [N²/V²].

    The errors of different loads are taken to be independent. That of a load along its force is in
    proportion to it (its weight, friction of the pulley), with another factor across it (direction
    of the thread). Both factors are found from the residuals of F_x and F_y together, and widened
    by Student's t for as many degrees of freedom as determine them.
    """
    solver = np.linalg.pinv(design)
    leaves = np.eye(len(design)) - design @ solver
    squares = forces**2
    floor = _FLOOR**2 * squares.max()
    across = squares[:, ::-1]
    factors = [_factor(leaves, errors, shape + floor) for shape in (squares, across)]
    variances = factors[0] * (squares + floor) + factors[1] * across
    return [solver[:2] * variances[:, axis] @ solver[:2].T for axis in (0, 1)]


def _factor(leaves: _Vectors, errors: _Vectors, shape: _Vectors) -> float:
    """Return what to multiply `shape` by for the variances of these errors, widened by Student's t.

    leaves: projection of the errors of the loads on those that the fit leaves over
    shape: variance of the error of each load, along x and y, up to that factor
    """
    weight = shape / shape.max()
    modes = []
    for axis in (0, 1):
        spread = leaves * np.sqrt(shape[:, axis])
        modes.append(np.linalg.eigvalsh(spread.T @ (weight[:, axis, np.newaxis] * spread)))
    expected = np.concatenate(modes)
    freedom = expected.sum() ** 2 / (expected**2).sum()
    widening = np.interp(-1.0 / max(freedom, 1.0), -1.0 / np.array(_FREEDOM), np.log(_STUDENT))
    return float((weight * errors**2).sum() / expected.sum() * (np.exp(widening) / 1.96) ** 2)


def _with_load_error(covariance: _Vectors, gains: _Vectors, load_error: float) -> Covariance:
    """Return variance, covariance and variance of two gains, with the error that all loads share.

    That error multiplies all gains by the same number.
    """
    whole = covariance + (load_error / 1.96) ** 2 * np.outer(gains, gains)
    return float(whole[0, 0]), float(whole[0, 1]), float(whole[1, 1])


def check(fitted: Fit, loads: Sequence[Load], names: Sequence[str]) -> None:
    """Raises `PoorLoads`, which names the worst load, unless the fit has to do with the loads."""
    size = math.sqrt(sum(load.fx**2 + load.fy**2 for load in loads) / (2 * len(loads)))
    residual = fitted.calibration.residual
    if residual > WORST_RESIDUAL * size:
        raise PoorLoads(
            f"the voltages do not follow the loads: the residual is {residual / size:.0%} of them "
            f"(rms), and at most {WORST_RESIDUAL:.0%} is a fit; measure {worst(fitted, names)} "
            "again first"
        )


def worst(fitted: Fit, names: Sequence[str]) -> str:
    """The name of the load with the largest error."""
    sizes = [math.hypot(*error) for error in fitted.errors]
    return names[sizes.index(max(sizes))]


def missing_loads(forces: Sequence[tuple[float, float]]) -> list[str]:
    """What has to be added to these loads (F_x, F_y) [N] for a calibration; nothing if empty."""
    if not all(math.isfinite(f) for force in forces for f in force):
        return ["every load must be a finite number"]
    largest = max((math.hypot(*force) for force in forces), default=0.0)
    least = _NOTICEABLE * largest
    there = {
        "no load at all (zero)": any(math.hypot(*force) < least for force in forces),
        "a load along +x": any(fx > least for fx, _ in forces),
        "a load along -x": any(fx < -least for fx, _ in forces),
        "a load along +y": any(fy > least for _, fy in forces),
        "a load along -y": any(fy < -least for _, fy in forces),
    }
    if largest == 0.0:
        there["no load at all (zero)"] = bool(forces)
    missing = [f"{name} is missing" for name, found in there.items() if not found]
    if not missing and _condition(np.array(forces)) > WORST_CONDITION:
        missing.append("all loads are on one line; a load across it is missing")
    if not missing and len(forces) < FEWEST_LOADS:
        missing.append(f"{FEWEST_LOADS} loads are needed, there are {len(forces)}")
    return missing


def _condition(vectors: _Vectors) -> float:
    """Largest spread of these points in the plane over their smallest; infinite on a line."""
    widths = np.linalg.svd(vectors - vectors.mean(axis=0), compute_uv=False)
    return float(widths[0] / widths[-1]) if widths[-1] > 0.0 else math.inf


def _dull(voltages: _Vectors) -> str:
    """Which channel hardly moves, in words."""
    spread = np.ptp(voltages, axis=0)
    for mine, other, name in ((0, 1, "x"), (1, 0, "y")):
        if spread[mine] < spread[other] / WORST_CONDITION:
            return (
                f"V_{name} moved by {spread[mine] * 1e3:.3g} mV only; is the sensor wired to "
                f"force_sensor.channel_{name}?"
            )
    return "both channels moved together; were loads along x and along y hung as planned?"
