"""The verb `fishctl measure`, which measures a controller's thrust on a live or simulated fish."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.experiment_options import (
    ChosenFish,
    ExperimentEnding,
    ExperimentFolder,
    ResumableGroup,
    fish_choice,
    keep_experiment,
    live_folder_options,
    record_session,
)
from fishd.cli.options import FiniteRange, for_option, json_option, plot_option
from fishd.cli.output import echo, format_controller, print_json
from fishd.cli.progress import show_progress
from fishd.core.console import format_power

if TYPE_CHECKING:
    from fishd.lab.measurement import ThrustMeasurement


def measure_options(function: Any) -> Any:
    """Add the options of this verb."""
    for option in (
        json_option,
        plot_option("raw force, fitted drift and corrected thrust"),
        fish_choice,
        live_folder_options,
        click.option(
            "--settle",
            type=FiniteRange(0.0, 600.0),
            default=1.5,
            show_default=True,
            help="Time until the fin swims steadily, and until it is at rest [s].",
        ),
        for_option("Length of the whole measurement, rests included [s].", default=60.0),
    ):
        function = option(function)
    return function


@click.group(cls=ResumableGroup, options=measure_options, remote=True)
def measure() -> None:
    """Measure a controller's thrust, with its 95 % interval.

    The fish alternately swims for about 6 s and rests for 3 s. This separates the thrust from a
    drift of the force sensor; only whole beats count. The fish must be at rest before, and is at
    rest afterwards. A running fishd then uses this measurement to show its thrust.
    """


@measure.action
def _measure(
    name: str,
    parameters: dict[str, Any],
    seconds: float,
    settle: float,
    fish: ChosenFish,
    place: ExperimentFolder,
    picture: Path | None,
    as_json: bool,
) -> int:
    from fishd.lab import drawing
    from fishd.lab.error_budget import unknown_calibration
    from fishd.lab.measurement import measure as run_measurement
    from fishd.lab.measurement import summarise
    from fishd.lab.session import LiveSession
    from fishd.lab.swim_plan import plan

    if picture:
        drawing.check(picture)
    plan(seconds, parameters, settle)  # before the experiment has a folder
    settings = {"controller": name, "parameters": parameters, "for": seconds, "settle": settle}
    with (
        fish.session() as session,
        keep_experiment(place, fish, session, settings) as experiment,
    ):
        fish.announce(as_json)
        ending = ExperimentEnding(experiment)
        with (
            ending.measuring(),
            session,
            record_session(experiment, session),
            show_progress(seconds, "s", err=as_json) as bar,
        ):
            session.progress = bar.at
            measured = run_measurement(session, name, parameters, seconds, settle)
        if ending.is_interrupted:
            return ending.interrupted("the fish rests")
        result = summarise(measured, session.tick)
        if experiment:
            experiment.write_struct("result.json", result)
        if (
            isinstance(session, LiveSession)
            and measured.thrust > measured.thrust_ci95
            and not measured.remark
        ):
            session.fish.calibrate_thrust(
                measured.thrust / measured.power, measured.thrust_ci95 / measured.power
            )
    if as_json:
        print_json(result)
    else:
        echo(_format_result(measured))
        if experiment:
            echo(f"folder: {experiment.path}")
    if line := unknown_calibration(measured.calibration_ci95, measured.unit):
        echo(f"fishctl: {line}", err=True)
    if picture:
        from fishd.lab.measurement_figure import draw

        draw(measured, session.tick, picture)
    return 0


def _format_result(measured: "ThrustMeasurement") -> str:
    from fishd.lab import error_budget
    from fishd.lab.disturbances import spell

    command = format_controller(measured.controller, dict(measured.parameters))
    thrust = error_budget.format_with_budget(
        measured.thrust,
        measured.thrust_ci95,
        measured.calibration_ci95,
        measured.total_ci95,
        measured.unit,
        measured.rotation,
    )
    line = f"{command}: thrust {thrust} at {measured.frequency:.3f} Hz, from {measured.swims} swims"
    disturbances = spell(measured.disturbances, measured.unit)
    return (
        line
        + _format_power(measured)
        + (f"; accounted for: {disturbances}" if disturbances else "")
        + (f"; careful: {measured.remark}" if measured.remark else "")
    )


def _format_power(measured: "ThrustMeasurement") -> str:
    """Return the power of the servo and the thrust per watt; empty if the power is unknown."""
    from fishd.lab import error_budget
    from fishd.lab.statistics import per_watt

    thrust_per_watt, error = per_watt(
        measured.thrust, measured.thrust_ci95, measured.watts, measured.watts_ci95
    )
    if thrust_per_watt is None or error is None or not measured.watts:
        return ""
    _, total_ci95 = per_watt(
        measured.thrust, measured.total_ci95, measured.watts, measured.watts_ci95
    )
    calibration_ci95 = (
        None if measured.calibration_ci95 is None else measured.calibration_ci95 / measured.watts
    )
    budget = error_budget.format_with_budget(
        thrust_per_watt, error, calibration_ci95, total_ci95, f"{measured.unit} per W"
    )
    return f"; {format_power(measured.watts)}, {budget}"
