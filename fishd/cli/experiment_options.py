"""Options of experiments that are also those of other verbs: `--on`, `--dry-run`, `--resume`."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NoReturn

import click

from fishd.cli.output import echo, print_json
from fishd.core.addresses import ENDPOINT_VARIABLE, find_control_address, socket_path
from fishd.core.experiments import Plan
from fishd.core.process import unix_sockets

On = Literal["live", "simulation"]
RUN_ONLY_OPTIONS = {
    "--folder": 1, "--resume": 1, "--plot": 1, "--json": 0, "--take": 0, "--on": 1, "--endpoint": 1,
    "--cluster": 1, "--dry-run": 0,
}  # fmt: skip
"""Options that are not kept as they are given, and the number of words after each.

The header of an experiment has the fish that `--on` and `--endpoint` stand for."""
_COMMAND = "fishd.words"
"""Key of the command line in click's context, for the header of an experiment."""


on_option = click.option(
    "--on",
    type=click.Choice(["live", "simulation"]),
    help="live: the fish of the running fishd, real or simulated; simulation: a fish in virtual "
    "time. [default: live if a fishd runs and neither --config nor --set is given]",
)

dry_run_option = click.option(
    "--dry-run",
    "is_dry",
    is_flag=True,
    help="Check all of it, print how long it takes, and end: the fish rests.",
)


class FishOption(click.Option):
    """Option that applies to one kind of fish only: `on`."""

    def __init__(self, *names: Any, on: On, **settings: Any) -> None:
        super().__init__(*names, **settings)
        self.on = on
        scope = "Live" if on == "live" else "In simulation"
        self.help = f"{scope}: {self.help}"


def refuse_other_fish(context: click.Context, on: On) -> None:
    """Raise `UsageError` for an option that only applies to the other kind of fish."""
    for option in context.command.params:
        if isinstance(option, FishOption) and option.on != on:
            source = context.get_parameter_source(option.name or "")
            if source is click.core.ParameterSource.COMMANDLINE:
                raise click.UsageError(f"{option.opts[0]} is for --on {option.on}")


def end_dry_run(plan: Plan, as_json: bool) -> NoReturn:
    """Print what an experiment is going to do, and end its verb."""
    if as_json:
        print_json(plan)
    elif plan.amount:
        unit = "" if plan.seconds is None or plan.unit.startswith("s") else f", {plan.seconds:g} s"
        echo(f"nothing is wrong with it; it takes {plan.amount:g} {plan.unit}{unit}")
    else:
        echo("nothing is wrong with it")
    raise click.exceptions.Exit(0)


def default_on(file: Path | None, overrides: tuple[str, ...], endpoint: str | None) -> On:
    """Return the kind of fish for a command line without `--on`."""
    if file or overrides:
        return "simulation"
    return "live" if endpoint or is_fishd_running() else "simulation"


def is_fishd_running() -> bool:
    """Return whether a client would reach a fishd by default; $FISHD_ENDPOINT counts as one."""
    path = socket_path(find_control_address())
    return bool(os.environ.get(ENDPOINT_VARIABLE)) or bool(
        path and path.exists() and not unix_sockets.is_deserted(path)
    )


def restore_arguments(
    context: click.Context,
    args: list[str],
    read_command: Callable[[click.Context, Path], list[str]],
    run_only: Mapping[str, int] = RUN_ONLY_OPTIONS,
) -> list[str]:
    """Return the arguments of a verb, after those of what `--resume` names.

    The arguments are kept for a later `--resume`: see `kept_arguments`.

    read_command: returns the arguments that are kept in a folder or file
    run_only: options that are not kept, and the number of words after each
    """
    path = next((b for a, b in pairwise(args) if a == "--resume"), None)
    path = path or next((a[9:] for a in args if a.startswith("--resume=")), None)
    if path is not None and args[0].startswith("-"):
        args = [*read_command(context, Path(path)), *args]
    context.meta[_COMMAND] = list(_without_options(args, run_only))
    return args


def kept_arguments(context: click.Context) -> tuple[str, ...]:
    """Return the arguments that a resumed experiment or swim takes over."""
    return tuple(context.meta.get(_COMMAND, ()))


def _without_options(args: Sequence[str], run_only: Mapping[str, int]) -> Iterator[str]:
    words = iter(args)
    for word in words:
        name, equals, _ = word.partition("=")
        if name not in run_only:
            yield word
        elif run_only[name] and not equals:
            next(words, None)
