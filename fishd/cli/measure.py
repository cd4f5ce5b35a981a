"""The verb `fishctl measure`, which measures a controller's thrust on a live or simulated fish."""

from typing import TYPE_CHECKING, Any

import click

from fishd.cli.experiment import MEASURED_TAIL, ResumableGroup, Run, experiment_options
from fishd.cli.options import FiniteRange, for_option
from fishd.cli.output import echo, format_controller
from fishd.controllers.base import Limits
from fishd.core.console import format_power
from fishd.core.experiments import CurvePoint

if TYPE_CHECKING:
    from fishd.lab.measurement import Summary

measure_options = experiment_options(
    for_option("Length of the whole measurement, rests included [s].", default=60.0),
    click.option(
        "--settle",
        type=FiniteRange(0.0, 600.0),
        default=1.5,
        show_default=True,
        help="Time until the fin swims steadily, and until it is at rest [s].",
    ),
    tail=MEASURED_TAIL,
    plot="raw force, fitted drift and corrected thrust",
)


@click.group(cls=ResumableGroup, options=measure_options, remote=True)
def measure() -> None:
    """Measure a controller's thrust, with its 95 % interval.

    The fish alternately swims for about 6 s and rests for 3 s. This separates the thrust from a
    drift of the force sensor; only whole beats count. The fish must be at rest before, and is at
    rest afterwards. A running fishd then uses this measurement to show its thrust.
    """


@measure.action
def _measure(
    name: str, parameters: dict[str, Any], seconds: float, settle: float, run: Run
) -> None:
    from fishd.core.swim_plan import plan
    from fishd.lab import measurement, measurement_figure
    from fishd.lab.error_budget import Thrust, estimate_thrust, warn_of_unknown_calibration
    from fishd.lab.session import LiveSession
    from fishd.lab.sweep import grid

    plan(seconds, parameters, settle)  # before the experiment has a folder
    session = run.session()
    if run.fish.on == "live":
        grid.check_remote([grid.Point(name, parameters)], Limits(session.amplitude, session.tick))
    run.open({"controller": name, "parameters": parameters, "for": seconds, "settle": settle})
    with run.swimming(seconds) as show:

        def show_thrust(thrust: Thrust, swims: int) -> None:
            point = CurvePoint(swims, thrust.thrust, thrust.known_ci95, "swims", unit=session.unit)
            show.estimate([estimate_thrust("thrust", thrust, session.unit)], point)

        measured = measurement.measure(session, name, parameters, seconds, settle, show_thrust)
    run.check()
    result = measured.summary()
    if (
        isinstance(session, LiveSession)
        and result.thrust > result.thrust_ci95
        and not result.remark
    ):
        session.fish.calibrate_thrust(result.factor, result.factor_ci95)
    estimates = [estimate_thrust("thrust", result, session.unit)]
    run.show(result, lambda: _print_result(result, run), estimates=estimates)
    if line := warn_of_unknown_calibration(result, result.force_unit):
        echo(f"fishctl: {line}", err=True)
    if run.picture:
        measurement_figure.draw(measured, session.tick, run.picture)


def _print_result(result: "Summary", run: Run) -> None:
    from fishd.lab.disturbances import spell
    from fishd.lab.error_budget import format_fin_angle, format_per_watt, format_thrust

    clauses = [
        f"{format_controller(result.controller, result.parameters)}: thrust "
        f"{format_thrust(result, result.force_unit)} at {result.frequency:.3f} Hz, from "
        f"{result.swims} swims",
    ]
    if result.power and result.thrust_per_watt is not None:
        clauses.append(
            f"{format_power(result.power)}, {format_per_watt(result, result.force_unit)}"
        )
    if fin_angle := format_fin_angle(result):
        clauses.append(f"largest fin angle {fin_angle}")
    if disturbances := spell(result.disturbances, result.force_unit):
        clauses.append(f"accounted for: {disturbances}")
    if result.remark:
        clauses.append(f"careful: {result.remark}")
    echo("; ".join(clauses))
    run.echo_folder()
