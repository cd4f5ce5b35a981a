"""The verb that runs a controller again on a recording."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.config import set_option
from fishd.cli.options import ParameterType, json_option
from fishd.cli.output import echo, format_controller, format_count, print_json
from fishd.cli.recording.files import folder_option, open_recording
from fishd.controllers import registry
from fishd.lab.rerun import Estimates, Stretch
from fishd.lab.rerun import rerun as choose_again


@click.command()
@click.argument("run")
@click.argument("parameters", nargs=-1, metavar="[NAME=VALUE]...")
@click.option(
    "--controller",
    metavar="NAME",
    help="Controller that chooses, such as swing:C=0.4; default: the one that swam.",
)
@set_option
@folder_option
@json_option
def rerun(
    run: str,
    parameters: tuple[str, ...],
    controller: str | None,
    overrides: tuple[str, ...],
    folder: Path | None,
    as_json: bool,
) -> int:
    """Run a controller again on each recorded tick, and compare its commands.

    RUN is a path, a name in the folder of recordings, or 'latest'. The controller sees the recorded
    forces and angles. The recorded controller must give the same commands to the last bit, from
    each of its starts in the recording. Exit status 1 if it does not, or if no controller swam. A
    controller that started before the recording is compared, too, but a difference is no failure.

    fishctl rerun latest --controller swing C=0.4
    """
    if controller:
        controller, pairs = registry.split_spec(controller)
        parameters = (*(f"{key}={value}" for key, value in pairs), *parameters)
    values = _convert_parameters(controller, parameters)
    recorded = open_recording(run, folder)
    result = choose_again(recorded, controller, values, overrides)
    if as_json:
        print_json(result)
    else:
        for stretch in result.stretches:
            _print_stretch(stretch)
        _print_estimates(result.estimates)
    if not result.stretches:
        echo(f"fishctl: {recorded.path}: no controller swam, so none can choose again", err=True)
        return 1
    is_unchanged = controller is None and not values and not overrides
    differing = [s for s in result.stretches if s.from_start and s.equal < s.ticks]
    return 1 if is_unchanged and differing else 0


def _convert_parameters(controller: str | None, words: tuple[str, ...]) -> dict[str, Any]:
    if not words:
        return {}
    if controller is None:
        raise click.UsageError(
            f"'{words[0]}': --controller is needed, to say whose parameter it is"
        )
    fields = {field.name: field for field in registry.describe(controller).parameters}
    values: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise click.UsageError(f"'{word}': NAME=VALUE is needed")
        field = fields.get(name)
        values[name] = ParameterType(field).convert(value, None, None) if field else value
    return values


def _print_stretch(stretch: Stretch) -> None:
    controller = format_controller(stretch.recorded, stretch.parameters)
    rerun_by = "" if stretch.controller == stretch.recorded else f", {stretch.controller} again"
    echo(f"from tick {stretch.seq}: {controller}{rerun_by}")
    share = f"{stretch.equal} of {format_count(stretch.ticks, 'command')} equal to the last bit"
    if stretch.equal == stretch.ticks:
        echo(f"  all {share}")
    else:
        echo(
            f"  {share}; the others by up to {stretch.largest:.3g} rad, the last one in tick "
            f"{stretch.differs_last}"
        )
    if not stretch.from_start:
        echo("  it swam already when these ticks begin, so its past is not known")


def _print_estimates(estimates: Estimates) -> None:
    echo(
        f"estimates: {estimates.equal} of {format_count(estimates.ticks, 'tick')} "
        "equal to the last bit"
    )
    if not estimates.from_start:
        echo("  fishd estimated already when these ticks begin, so its past is not known")
