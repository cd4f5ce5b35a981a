"""The verb that finds a controller's thrust with its interval, on a live or a simulated fish."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.config import fish_options
from fishd.cli.lab_progress import showing
from fishd.cli.lease_options import take_option, verb_lease
from fishd.cli.options import ControllerGroup, FiniteRange, endpoint_option, json_option
from fishd.cli.output import echo, print_json, spelled
from fishd.client import Fish
from fishd.config import load
from fishd.core.console import INTERRUPTED, power_words
from fishd.core.process.interruption import interrupted_once

if TYPE_CHECKING:
    from fishd.lab.measurement import Measured


def measure_options(function: Any) -> Any:
    """The options of this verb."""
    for option in (
        json_option,
        endpoint_option,
        take_option,
        fish_options,
        click.option(
            "--plot",
            "picture",
            type=click.Path(path_type=Path, dir_okay=False),
            help="Draw raw force, fitted drift and corrected thrust into this file (.png, .svg).",
        ),
        click.option(
            "--on",
            "where",
            type=click.Choice(["robot", "simulation"]),
            default="robot",
            show_default=True,
            help="The fish of a running fishd, or one in virtual time.",
        ),
        click.option(
            "--settle",
            type=FiniteRange(0.0, 600.0),
            default=1.5,
            show_default=True,
            help="How long the fin takes to swim steadily, and to come to rest [s].",
        ),
        click.option(
            "--for",
            "seconds",
            type=float,
            default=60.0,
            show_default=True,
            help="Length of the whole measurement, rests included [s].",
        ),
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
    where: str,
    picture: Path | None,
    file: Path | None,
    overrides: tuple[str, ...],
    endpoint: str | None,
    as_json: bool,
) -> int:
    from fishd.lab import drawing
    from fishd.lab.measurement import measure as run
    from fishd.lab.measurement import summary
    from fishd.lab.rig import LiveRig, Rig, VirtualRig

    if where == "robot" and (file or overrides):
        raise click.UsageError(
            "--config and --set describe a fish in virtual time: --on simulation"
        )
    if picture:
        drawing.check(picture)
    with ExitStack() as stack:
        stack.enter_context(interrupted_once())  # whatever ends it leaves the fish at rest
        rig: Rig
        if where == "simulation":
            rig = stack.enter_context(VirtualRig(load(file, overrides)))
            found = run(rig, name, parameters, seconds, settle=settle)
        else:
            fish = stack.enter_context(Fish(endpoint))
            rig = stack.enter_context(LiveRig(fish, *verb_lease()))
            try:
                with showing(seconds, "s") as bar:
                    found = run(rig, name, parameters, seconds, bar.at, settle)
            except KeyboardInterrupt:
                echo("fishctl: interrupted: the fish rests, nothing is measured", err=True)
                return INTERRUPTED
            if found.thrust > found.error and not found.remark:
                fish.calibrate_thrust(found.thrust / found.power, found.error / found.power)
    if as_json:
        print_json(summary(found, rig.tick))
    else:
        echo(_line(found))
    for line in _careful(found):
        echo(f"fishctl: {line}", err=True)
    if picture:
        from fishd.lab.measurement_figure import draw

        draw(found, rig.tick, picture)
    return 0


def _line(found: "Measured") -> str:
    from fishd.lab import error_budget
    from fishd.lab.disturbances import spell

    what = spelled(found.controller, dict(found.parameters))
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
    from fishd.lab.objective import per_watt

    gave, error = per_watt(found.thrust, found.error, found.watts, found.watts_error)
    if gave is None or error is None or not found.watts:
        return ""
    _, total = per_watt(found.thrust, found.total_ci95, found.watts, found.watts_error)
    part = None if found.calibration_ci95 is None else found.calibration_ci95 / found.watts
    budget = error_budget.spelled(gave, error, part, total, f"{found.unit} per W")
    return f"; {power_words(found.watts)}, {budget}"
