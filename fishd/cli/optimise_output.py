"""What `fishctl optimise` says: each candidate as it was measured, and the best in the end."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct

from fishd.cli.output import counted, echo
from fishd.core import text
from fishd.core.console import power_words
from fishd.core.schema import format_values

if TYPE_CHECKING:
    from fishd.core.calibration import ForceCalibration
    from fishd.lab.optimise.aim import Aim
    from fishd.lab.optimise.least_power import LeastPower
    from fishd.lab.optimise.search import Proposal, Search
    from fishd.lab.optimise.trials import Trial


class Optimum(Struct, frozen=True):
    """What a search found, as a program reads it."""

    controller: str
    parameters: dict[str, float]
    low: dict[str, float]
    """The 95 % interval of each."""
    high: dict[str, float]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    improvement: float
    """Expected of another trial, as a share of what is searched."""
    trials: int
    ticks_swum: int
    seconds: float
    """In the tank, rest included [s]."""
    objective: str = "thrust"
    target: float | None = None
    """The thrust that was to be reached [N]."""
    power: float | None = None
    """Electrical power of the servo [W]; null where it is not known."""
    power_error: float | None = None
    """Half of its 95 % interval [W]."""
    thrust_per_watt: float | None = None
    """[N/W]"""
    thrust_per_watt_error: float | None = None
    """Half of its 95 % interval [N/W]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval that the calibration leaves to the thrust [N].

    null where its uncertainty is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `error` and `calibration_ci95` together [N]."""
    thrust_per_watt_calibration_ci95: float | None = None
    """As `calibration_ci95`, of the thrust for each watt [N/W]."""
    thrust_per_watt_total_ci95: float | None = None
    """As `total_ci95`, of the thrust for each watt [N/W]."""
    rotation: float = 0.0
    """Rotation of the sensor's axes that is left after calibration; 0 where none is seen [rad]."""
    thinking: float | None = None
    """How long the fish of a robot waited besides while candidates were chosen, this time [s]."""
    true_thrust: float | None = None
    """There, of a simulated fish [N]."""
    relative_thrust: float | None = None
    """That over the thrust of the best square wave."""
    true_power: float | None = None
    """There, of a simulated servo [W]."""


def told(
    number: int, trial: "Trial", best: "Proposal | None", unit: str, units: dict[str, str]
) -> str:
    """A line on a trial.

    best: what seems so, once there is enough to say it
    unit: of the force; units: of the parameters
    """
    thrust = text.format_measured(trial.thrust, trial.error, unit)
    measured = f"{number}: {_spelled(trial.parameters, units)}: {thrust}"
    if math.isfinite(trial.power):
        measured += f" for {power_words(trial.power)}"
    if best is None:
        return measured
    more = f"another may give {best.improvement:.1%} more"
    return f"{measured}; best so far {_spelled(best.parameters, units)}, {more}"


def _spelled(parameters: dict[str, float], units: dict[str, str]) -> str:
    return format_values({name: float(f"{value:.4g}") for name, value in parameters.items()}, units)


def optimum_of(
    name: str,
    measured: "Sequence[Trial]",
    search: "Search | LeastPower",
    found: "Proposal",
    aim: "Aim",
    calibration: "ForceCalibration",
) -> Optimum:
    """What a search found; measured: all that it knows of; calibration: of the force sensor"""
    from fishd.lab.error_budget import budget
    from fishd.lab.objective import per_watt

    last = measured[-1]
    force = [(each.parameters, each.thrust, each.error) for each in measured]
    thrust, error = search.alike(force).expected(found.parameters)
    power = power_error = None
    if all(math.isfinite(each.power) for each in measured):
        taken = [(each.parameters, each.power, each.power_error) for each in measured]
        power, power_error = search.alike(taken).expected(found.parameters)
    gives, gives_error = per_watt(thrust, error, power, power_error)
    if aim.objective == "thrust-per-watt" and aim.target is None:
        gives, gives_error = found.value, found.error
    rotations = [each.rotation for each in measured if each.rotation]
    rotation = sum(rotations) / len(rotations) if rotations else 0.0
    whole = budget(calibration, thrust, error, rotation=rotation)
    whole_per_watt = (
        None if gives is None else budget(calibration, gives, gives_error, rotation=rotation)
    )
    return Optimum(
        controller=name,
        parameters=found.parameters,
        low=found.low,
        high=found.high,
        thrust=thrust,
        error=error,
        improvement=found.improvement,
        trials=len(measured),
        objective=aim.objective if aim.target is None else "least-power",
        target=aim.target,
        power=power,
        power_error=power_error,
        thrust_per_watt=gives,
        thrust_per_watt_error=gives_error,
        calibration_ci95=whole.calibration_ci95,
        total_ci95=whole.total_ci95,
        rotation=rotation,
        thrust_per_watt_calibration_ci95=whole_per_watt and whole_per_watt.calibration_ci95,
        thrust_per_watt_total_ci95=whole_per_watt and whole_per_watt.total_ci95,
        ticks_swum=last.swum,
        seconds=last.passed,
    )


def say(found: Optimum, unit: str, units: dict[str, str], path: Path) -> None:
    """Show what was found; units: of the parameters, unit: of the force."""
    from fishd.lab import error_budget

    for name, value in found.parameters.items():
        symbol = "" if units[name] in ("", "1") else f" {units[name]}"
        interval = f"[{found.low[name]:.4g}, {found.high[name]:.4g}]"
        echo(f"best {name} of {found.controller}: {value:.4g}{symbol} {interval}")
    thrust = error_budget.spelled(
        found.thrust, found.error, found.calibration_ci95, found.total_ci95, unit
    )
    echo(f"thrust there: {thrust}")
    if found.power is not None and found.power_error is not None:
        gives = error_budget.spelled(
            found.thrust_per_watt or 0.0,
            found.thrust_per_watt_error or 0.0,
            found.thrust_per_watt_calibration_ci95,
            found.thrust_per_watt_total_ci95,
            f"{unit} per W",
        )
        echo(f"power there: {found.power * 1e3:.0f} ± {found.power_error * 1e3:.0f} mW, {gives}")
    unknown = error_budget.unknown_calibration(found.calibration_ci95, unit)
    for line in filter(None, (unknown, error_budget.rotation_remark(found.rotation))):
        echo(f"fishctl: {line}", err=True)
    if found.target is not None and found.thrust < found.target:
        echo(f"fishctl: no parameters are known that give {found.target * 1e3:g} m{unit}", err=True)
    if found.true_thrust is not None:
        taking = "" if found.true_power is None else f" for {power_words(found.true_power)}"
        echo(
            f"true thrust there: {found.true_thrust * 1e3:.2f} mN{taking}, "
            f"{found.relative_thrust:.1%} of the best square wave"
        )
    thinking = "" if found.thinking is None else f"; {found.thinking:.0f} s of thinking besides"
    echo(
        f"{counted(found.trials, 'candidate')}, {found.ticks_swum} ticks of swimming, "
        f"{found.seconds:.0f} s with the rests{thinking}"
    )
    echo(f"table: {path / 'trials.csv'}")
