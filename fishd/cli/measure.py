"""The verb that finds a controller's thrust with its interval, on a live or a simulated fish."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.experiment_options import ChosenFish, fish_choice, keep_option, keep_session
from fishd.cli.options import ControllerGroup, FiniteRange, for_option, json_option, plot_option
from fishd.cli.output import echo, format_controller, print_json
from fishd.cli.progress import show_progress
from fishd.core.console import INTERRUPTED, power_words
from fishd.core.process.interruption import interrupted_once

if TYPE_CHECKING:
    from fishd.lab.measurement import Measured


def measure_options(function: Any) -> Any:
    """The options of this verb."""
    for option in (
        json_option,
        plot_option("raw force, fitted drift and corrected thrust"),
        keep_option,
        fish_choice,
        click.option(
            "--settle",
            type=FiniteRange(0.0, 600.0),
            default=1.5,
            show_default=True,
            help="How long the fin takes to swim steadily, and to come to rest [s].",
        ),
        for_option("Length of the whole measurement, rests included [s].", default=60.0),
    ):
        function = option(function)
    return function


@click.group(cls=ControllerGroup, options=measure_options, remote=True)
def measure() -> None:
    """Find a controller's thrust, with its 95 % interval.

    The fish swims and rests in turn, about 6 s and 3 s, which separates the thrust from a
    drift of the force sensor; only whole beats count. The fish must be at rest before, and is at
    rest afterwards. A running fishd shows its thrust by this measurement from then on.
    """


@measure.action
def _measure(
    name: str,
    parameters: dict[str, Any],
    seconds: float,
    settle: float,
    fish: ChosenFish,
    folder: Path | None,
    picture: Path | None,
    as_json: bool,
) -> int:
    from fishd.lab import drawing
    from fishd.lab.measurement import measure as run
    from fishd.lab.measurement import summary
    from fishd.lab.session import LiveSession

    if picture:
        drawing.check(picture)
    settings = {"controller": name, "parameters": parameters, "for": seconds, "settle": settle}
    try:
        with (
            interrupted_once(),
            fish.session() as session,
            session,
            keep_session(folder, fish, session, settings) as experiment,
            show_progress(seconds, "s") as bar,
        ):
            fish.announce(as_json)
            session.progress = bar.at
            found = run(session, name, parameters, seconds, settle)
            result = summary(found, session.tick)
            if experiment:
                experiment.write_struct("result.json", result)
            if isinstance(session, LiveSession) and found.thrust > found.error and not found.remark:
                session.fish.calibrate_thrust(found.thrust / found.power, found.error / found.power)
    except KeyboardInterrupt:
        echo("fishctl: interrupted: the fish rests, nothing is measured", err=True)
        return INTERRUPTED
    if as_json:
        print_json(result)
    else:
        echo(_line(found))
    for line in _careful(found):
        echo(f"fishctl: {line}", err=True)
    if picture:
        from fishd.lab.measurement_figure import draw

        draw(found, session.tick, picture)
    return 0


def _line(found: "Measured") -> str:
    from fishd.lab import error_budget
    from fishd.lab.disturbances import spell

    what = format_controller(found.controller, dict(found.parameters))
    thrust = error_budget.spelled(
        found.thrust, found.error, found.calibration_ci95, found.total_ci95, found.unit
    )
    line = f"{what}: thrust {thrust} at {found.frequency:.3f} Hz, from {found.swims} swims"
    words = spell(found.disturbances, found.unit)
    return (
        line
        + _power(found)
        + (f"; accounted for: {words}" if words else "")
        + (f"; careful: {found.remark}" if found.remark else "")
    )


def _careful(found: "Measured") -> "Iterator[str]":
    """Yield what the interval does not cover, or covers only by a guess."""
    from fishd.lab.error_budget import rotation_remark, unknown_calibration

    if line := unknown_calibration(found.calibration_ci95, found.unit):
        yield line
    if line := rotation_remark(found.rotation):
        yield line


def _power(found: "Measured") -> str:
    """What the servo took, where that is known, and what a watt of it gave."""
    from fishd.lab import error_budget
    from fishd.lab.statistics import per_watt

    gave, error = per_watt(found.thrust, found.error, found.watts, found.watts_error)
    if gave is None or error is None or not found.watts:
        return ""
    _, total = per_watt(found.thrust, found.total_ci95, found.watts, found.watts_error)
    part = None if found.calibration_ci95 is None else found.calibration_ci95 / found.watts
    budget = error_budget.spelled(gave, error, part, total, f"{found.unit} per W")
    return f"; {power_words(found.watts)}, {budget}"
