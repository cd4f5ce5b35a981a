"""From known loads on the force sensor to its calibration; for `fishctl calibrate force`.

Force = C·[V_x, V_y, 1], least squares over the loads.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.core.calibration import ForceCalibration
from fishd.core.errors import FishdError

FEWEST_LOADS = 5
WORST_CONDITION = 100.0
"""Beyond this one direction is known so much worse than the other that the fit is refused."""
WORST_RESIDUAL = 0.2
"""A residual beyond this share of the loads, both as root mean squares, is no fit.

Voltages that have nothing to do with the loads leave about 0.7 with five of them; less than 0.2 is
then rarer than one in five hundred. The worst sensors that are of use leave 0.02.
"""
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


def fit(loads: Sequence[Load]) -> Fit:
    """The calibration that suits the loads best.

    Its `residual` is the root mean square of all errors [N], its `condition` the ratio of the
    largest to the smallest spread of the voltages. Raises `PoorLoads`.
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
    )
    return Fit(calibration, [(float(x), float(y)) for x, y in errors])


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
