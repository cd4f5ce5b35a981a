"""The verb that runs a controller again on a recording."""

from pathlib import Path

import click

from fishd.cli.completion import complete_contestant
from fishd.cli.config import set_option
from fishd.cli.controller_arguments import ControllersCommand
from fishd.cli.options import json_option
from fishd.cli.output import echo, format_controller, format_count, print_json
from fishd.cli.recording.files import folder_option, open_recording
from fishd.core import text
from fishd.lab.compare.contestants import parse
from fishd.lab.rerun import Estimates, Stretch
from fishd.lab.rerun import rerun as choose_again


@click.command(cls=ControllersCommand)
@click.argument("run")
@click.argument("controller", required=False, shell_complete=complete_contestant)
@set_option
@folder_option
@json_option
def rerun(
    run: str,
    controller: str | None,
    overrides: tuple[str, ...],
    folder: Path,
    as_json: bool,
) -> int:
    """Run a controller again on each recorded tick, and compare its commands.

    RUN is a path, a name in the folder of recordings, or 'latest'. CONTROLLER is a policy, or a
    controller with its parameters, such as swing:C=0.4 or swing --C 0.4; the default is the one
    that swam. It sees the recorded forces and angles. The recorded controller must give the same
    commands to the last bit, from each of its starts in the recording. Exit status 1 if it does
    not, or if no controller swam. A controller that started before the recording is compared, too,
    but a difference is no failure.
    """
    _, name, values = parse(controller) if controller else ("", None, {})
    recorded = open_recording(run, folder)
    result = choose_again(recorded, name, values, overrides)
    if as_json:
        print_json(result)
    else:
        for stretch in result.stretches:
            _print_stretch(stretch, controller)
        _print_estimates(result.estimates)
    if not result.stretches:
        echo(f"fishctl: {recorded.path}: no controller swam, so none can choose again", err=True)
        return 1
    is_unchanged = name is None and not overrides
    differing = [s for s in result.stretches if s.from_start and s.equal < s.ticks]
    return 1 if is_unchanged and differing else 0


def _print_stretch(stretch: Stretch, controller: str | None) -> None:
    """Print the result of a stretch; controller: the one that chose, if it is another one."""
    recorded = format_controller(stretch.recorded, stretch.parameters)
    chosen_by = f"; chosen again by {text.line(controller)}" if controller else ""
    echo(f"from tick {stretch.seq}: {recorded}{chosen_by}")
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
