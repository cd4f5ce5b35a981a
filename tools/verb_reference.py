"""Writer of the table of verbs and their shared options into docs/, from the commands.

python tools/verb_reference.py --write
python tools/verb_reference.py --check     exits with 1 when it is out of date
"""

import sys
from collections.abc import Iterator

import click

from common.report import table, write_reference
from fishd.cli.controller_arguments import ControllerGroup
from fishd.cli.main import fishctl

SHARED = (
    *("--on", "--for", "--budget", "--folder", "--resume", "--to", "--plot", "--json", "--seed"),
    *("--config", "--endpoint", "--take"),
)
"""Options with the same meaning for all verbs, in the order of the table."""


def commands(
    command: click.Command, path: tuple[str, ...] = ()
) -> Iterator[tuple[str, click.Command]]:
    """Yield each verb with its command; of a verb that takes a controller, with `square`."""
    context = click.Context(command)
    if isinstance(command, ControllerGroup):
        subcommand = command.get_command(context, "square")
        assert subcommand
        yield " ".join(path), subcommand
    elif isinstance(command, click.Group):
        if command.invoke_without_command:
            yield " ".join(path), command
        for name in command.list_commands(context):
            verb = command.get_command(context, name)
            assert verb
            yield from commands(verb, (*path, name))
    else:
        yield " ".join(path), command


def options(command: click.Command) -> set[str]:
    """Return the names of the options of a command."""
    return {
        name
        for parameter in command.params
        if isinstance(parameter, click.Option)
        for name in parameter.opts
    }


def reference() -> str:
    """Return the table: a row for each set of shared options, and the verbs that have it."""
    verbs: dict[str, list[str]] = {}
    for verb, command in commands(fishctl):
        shared = " ".join(f"`{option}`" for option in SHARED if option in options(command))
        if shared:
            verbs.setdefault(shared, []).append(f"`{verb}`")
    return table(
        "verbs | shared options", ([", ".join(names), own] for own, names in verbs.items())
    )


if __name__ == "__main__":
    sys.exit(write_reference("verb_reference", [("reference/verbs.md", "options", reference())]))
