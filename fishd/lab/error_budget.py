"""Error budget of a measured thrust: statistics, gains of the calibration, rotation of the sensor.

The statistical error is that of one measurement. The error of the gains is the same fraction of
all thrusts measured with one calibration, so it counts for newtons and newtons per watt, and
cancels in the ratio of two thrusts.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import NamedTuple

import numpy as np
from msgspec import UNSET

from fishd.core import text
from fishd.core.beats import upward_reversals
from fishd.core.calibration import ForceCalibration
from fishd.core.estimation import SWIM_SETTLE_TIME_S
from fishd.core.signals import Tick
from fishd.lab.statistics import Z95

MIN_ROTATION_RAD = 0.01
"""Smallest rotation that counts; a smaller one hides less than 0.005 % of a thrust."""
MIN_ELONGATION = 4.0
"""Smallest ratio of the variances along the principal axes that defines their direction."""


class Budget(NamedTuple):
    """Half-widths of the 95 % intervals of a thrust, in its unit."""

    calibration_ci95: float | None
    """Half-width from gains and rotation; None where the calibration's uncertainty is unknown."""
    total_ci95: float | None
    """Half-width from statistics and calibration; None where one of them is unknown."""


def budget(
    calibration: ForceCalibration,
    thrust: float,
    statistical_ci95: float | None,
    lateral: float = 0.0,
    rotation: float = 0.0,
) -> Budget:
    """Return the error budget of a thrust [N].

    Random errors are added in quadrature; the effect of a rotation is systematic and is added
    linearly.

    statistical_ci95: half-width of the statistical interval; None where unknown [N]
    lateral: mean F_y that swimming adds [N]
    rotation: rotation of the sensor's axes, from `visible_rotation` [rad]
    """
    gain_ci95 = calibration.thrust_ci95(thrust, lateral)
    if gain_ci95 is None:
        return Budget(None, None)
    cosine_loss = (math.cos(rotation) - 1.0) * thrust
    # `lateral` contains the drift of F_y, which must not cancel the effect of the rotation.
    hidden = max(abs(cosine_loss), abs(cosine_loss + math.sin(rotation) * lateral))
    total = None if statistical_ci95 is None else math.hypot(statistical_ci95, gain_ci95) + hidden
    return Budget(gain_ci95 + hidden, total)


def format_with_budget(
    value: float,
    statistical_ci95: float,
    calibration_ci95: float | None,
    total_ci95: float | None,
    unit: str,
    rotation: float = 0.0,
) -> str:
    """Return a force, or a force for each watt, with its error budget, in thousandths of its unit.

    Where the part of the calibration is unknown, the text gives the statistical error and says so.

    rotation: rotation of the sensor's axes, from `visible_rotation`; it is part of the calibration
    """
    if calibration_ci95 is None or total_ci95 is None:
        total_ci95 = statistical_ci95
        calibration = "unknown" if unit.startswith("N") else "none"
    else:
        calibration = text.format_half_width(calibration_ci95)
    return (
        f"{text.format_measured(value, total_ci95, unit)} "
        f"(statistical {text.format_half_width(statistical_ci95)}, calibration {calibration}"
        + (f", with the sensor rotated by {math.degrees(rotation):+.1f}°)" if rotation else ")")
    )


def unknown_calibration(calibration_ci95: float | None, unit: str) -> str:
    """Return a remark on a calibration of unknown uncertainty; empty where it is known."""
    if calibration_ci95 is not None:
        return ""
    if unit != "N":
        return (
            f"the force sensor is not calibrated: forces are in {text.quoted(unit)}, and no "
            "interval includes the error of its gain; run 'fishctl calibrate force'"
        )
    return (
        "the uncertainty of the gains of the force sensor is unknown, so the interval is "
        "statistical only; run 'fishctl calibrate force'"
    )


def visible_rotation(ticks: Iterable[Tick], settle: float = SWIM_SETTLE_TIME_S) -> float:
    """Return the angle by which F_x and F_y are rotated into each other while the fish swims [rad].

    Over whole beats of a symmetric gait the true F_x, at even harmonics, and the true F_y, at odd
    ones, are not correlated. 0 where the angle is below `MIN_ROTATION_RAD`, or its interval
    contains 0.

    settle: time until a swim is steady [s]
    """
    steady = _steady_swims(ticks, settle)
    swims = [np.array([(tick.fx, tick.fy) for tick in swim]) for swim in steady]
    deviations = [swim - swim.mean(axis=0) for swim in swims]
    if not deviations:
        return 0.0
    forces = np.concatenate(deviations)
    (xx, xy), (_, yy) = forces.T @ forces
    smallest, largest = np.linalg.eigvalsh(forces.T @ forces)
    if largest < MIN_ELONGATION * smallest:
        return 0.0
    angle = 0.5 * math.atan2(-2.0 * xy, yy - xx)
    # The error of a principal axis: Anderson, Ann. Math. Stat. 34 (1963) 122.
    angle_ci95 = Z95 * math.sqrt(smallest * largest / len(forces)) / (largest - smallest)
    return angle if abs(angle) >= max(MIN_ROTATION_RAD, angle_ci95) else 0.0


def lateral_force(ticks: Iterable[Tick]) -> float:
    """Return the mean F_y that swimming adds [N]; 0 without a whole beat and a rest."""
    ticks = list(ticks)
    swimming = [tick.fy for swim in _steady_swims(ticks, SWIM_SETTLE_TIME_S) for tick in swim]
    rests = _settled_phases(ticks, SWIM_SETTLE_TIME_S, swims=False)
    resting = [tick.fy for rest in rests for tick in rest]
    if not swimming or not resting:
        return 0.0
    return sum(swimming) / len(swimming) - sum(resting) / len(resting)


def _steady_swims(ticks: Iterable[Tick], settle: float) -> list[list[Tick]]:
    """Return the ticks of the whole beats of each steady swim."""
    beats = []
    for swim in _settled_phases(ticks, settle, swims=True):
        ups = upward_reversals(tick.phi_c for tick in swim)
        if len(ups) > 1:
            # The force of a tick is the mean over the period before it; its angle applies after it.
            beats.append(swim[ups[0] + 1 : ups[-1] + 1])
    return beats


def _settled_phases(ticks: Iterable[Tick], settle: float, *, swims: bool) -> Iterator[list[Tick]]:
    """Yield the ticks of each settled swim or rest, without suspect forces."""
    for running, group in groupby(ticks, lambda tick: tick.mode == "running"):
        phase = list(group)
        start = phase[0].time + settle
        if running is swims:
            yield [tick for tick in phase if tick.time >= start and tick.suspect is UNSET]
