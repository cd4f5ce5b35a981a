"""Error budget of a measured thrust: statistics, gains of the calibration, rotation of the sensor.

The statistical error is that of one measurement. The error of the gains is the same fraction of
all thrusts measured with one calibration, so it counts for newtons and newtons per watt, and
cancels in the ratio of two thrusts.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET, Struct

from fishd.core import text
from fishd.core.beats import upward_reversals
from fishd.core.calibration import ForceCalibration
from fishd.core.estimation import SWIM_SETTLE_TIME_S
from fishd.core.experiments import Estimate
from fishd.core.signals import Tick
from fishd.lab.statistics import Z95, per_watt

MIN_ROTATION_RAD = 0.01
"""Smallest rotation that counts; a smaller one hides less than 0.005 % of a thrust."""
MIN_ELONGATION = 4.0
"""Smallest ratio of the variances along the principal axes that defines their direction."""


class Thrust(Struct, frozen=True, kw_only=True):
    """A mean thrust with its error budget, and the power that it takes."""

    thrust: float
    """Mean thrust while the fish swims [N]."""
    thrust_ci95: float | None
    """Half-width of the 95 % confidence interval of `thrust`, statistical only [N]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval of the thrust that the calibration alone causes [N].

    null where the uncertainty of the calibration is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval from `thrust_ci95` and `calibration_ci95` together [N]."""
    rotation: float = 0.0
    """Rotation of the sensor's axes that remains after calibration; 0 where none is seen [rad]."""
    power: float | None = None
    """Electrical power of the servo while the fish swims [W]; null where unknown."""
    power_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `power`, from the spread of beats [W]."""
    thrust_per_watt: float | None = None
    """Thrust over electrical power [N/W]."""
    thrust_per_watt_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust_per_watt`, statistical only [N/W]."""
    thrust_per_watt_calibration_ci95: float | None = None
    """Half-width of the 95 % interval of `thrust_per_watt` due to the calibration [N/W]."""
    thrust_per_watt_total_ci95: float | None = None
    """Half-width of the 95 % interval of `thrust_per_watt`, calibration included [N/W]."""
    fin_angle_max: float | None = None
    """Mean over beats of the largest fin angle, as a camera measured it [rad]; null without one."""
    fin_angle_max_ci95: float | None = None
    """Half-width of the 95 % interval of `fin_angle_max`, from the spread of beats [rad]."""

    @property
    def known_ci95(self) -> float | None:
        """Total half-width of the thrust; the statistical one if the total is unknown [N]."""
        return self.thrust_ci95 if self.total_ci95 is None else self.total_ci95


def estimate_thrust(name: str, thrust: Thrust, unit: str) -> Estimate:
    """Return a thrust with its interval; unit: that of the force."""
    half = thrust.known_ci95
    low, high = (None, None) if half is None else (thrust.thrust - half, thrust.thrust + half)
    return Estimate(name, thrust.thrust, low, high, unit)


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


def thrust_fields(
    calibration: ForceCalibration,
    thrust: float,
    thrust_ci95: float | None,
    power: float | None = None,
    power_ci95: float | None = None,
    *,
    lateral: float = 0.0,
    rotation: float = 0.0,
    thrust_per_watt: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Return the fields of a `Thrust`, from a mean thrust [N] and power [W] and their half-widths.

    lateral, rotation: as for `budget`
    thrust_per_watt: thrust per watt and its half-width; None for the ratio of thrust and power
    """
    fields: dict[str, Any] = {"thrust": thrust, "thrust_ci95": thrust_ci95, "rotation": rotation}
    fields |= {"power": power, "power_ci95": power_ci95}
    fields |= budget(calibration, thrust, thrust_ci95, lateral, rotation)._asdict()
    value, ci95 = thrust_per_watt or per_watt(thrust, thrust_ci95, power, power_ci95)
    if power and value is not None:
        parts = budget(calibration, value, ci95, lateral / power, rotation)
        fields |= {
            "thrust_per_watt": value,
            "thrust_per_watt_ci95": ci95,
            "thrust_per_watt_calibration_ci95": parts.calibration_ci95,
            "thrust_per_watt_total_ci95": parts.total_ci95,
        }
    return fields


def format_thrust(measured: Thrust, unit: str) -> str:
    """Return a thrust with its error budget; unit: unit of the force."""
    return _format_with_budget(
        measured.thrust,
        measured.thrust_ci95,
        measured.calibration_ci95,
        measured.total_ci95,
        unit,
        measured.rotation,
    )


def format_per_watt(measured: Thrust, unit: str) -> str:
    """Return a known thrust per watt with its error budget; unit: unit of the force."""
    return _format_with_budget(
        measured.thrust_per_watt or 0.0,
        measured.thrust_per_watt_ci95,
        measured.thrust_per_watt_calibration_ci95,
        measured.thrust_per_watt_total_ci95,
        f"{unit} per W",
    )


def _format_with_budget(
    value: float,
    statistical_ci95: float | None,
    calibration_ci95: float | None,
    total_ci95: float | None,
    unit: str,
    rotation: float = 0.0,
) -> str:
    """Return a force, or a force for each watt, with its error budget, in thousandths of its unit.

    Where the part of the calibration is unknown, the text gives the statistical error and says so.
    """
    statistical = text.format_half_width(statistical_ci95 or 0.0)
    if calibration_ci95 is None or total_ci95 is None:
        total_ci95 = statistical_ci95
        calibration = "unknown" if unit.startswith("N") else "none"
    else:
        calibration = text.format_half_width(calibration_ci95)
    return (
        f"{text.format_measured(value, total_ci95, unit)} "
        f"(statistical {statistical}, calibration {calibration}"
        + (f", with the sensor rotated by {math.degrees(rotation):+.1f}°)" if rotation else ")")
    )


def format_fin_angle(measured: Thrust, unit: str = "rad") -> str:
    """Return the largest fin angle with its error; empty where it was not measured."""
    if measured.fin_angle_max is None:
        return ""
    return text.format_measured(measured.fin_angle_max, measured.fin_angle_max_ci95, unit)


def warn_of_unknown_calibration(measured: Thrust, unit: str) -> str | None:
    """Return a remark on a calibration of unknown uncertainty; None where it is known."""
    if measured.calibration_ci95 is not None:
        return None
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
    rests = settled_phases(ticks, SWIM_SETTLE_TIME_S, swims=False)
    resting = [tick.fy for rest in rests for tick in rest]
    if not swimming or not resting:
        return 0.0
    return sum(swimming) / len(swimming) - sum(resting) / len(resting)


def _steady_swims(ticks: Iterable[Tick], settle: float) -> list[list[Tick]]:
    """Return the ticks of the whole beats of each steady swim."""
    beats = []
    for swim in settled_phases(ticks, settle, swims=True):
        ups = upward_reversals(tick.phi_c for tick in swim)
        if len(ups) > 1:
            # The force of a tick is the mean over the period before it; its angle applies after it.
            beats.append(swim[ups[0] + 1 : ups[-1] + 1])
    return beats


def settled_phases(ticks: Iterable[Tick], settle: float, *, swims: bool) -> Iterator[list[Tick]]:
    """Yield the ticks of each settled swim or rest, without suspect forces."""
    for running, group in groupby(ticks, lambda tick: tick.mode == "running"):
        phase = list(group)
        start = phase[0].time + settle
        if running is swims:
            yield [tick for tick in phase if tick.time >= start and tick.suspect is UNSET]
