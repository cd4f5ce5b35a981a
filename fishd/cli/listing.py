"""The verbs that list what can swim the fish: controllers, and policies that have a name."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from fishd import client
from fishd.cli.controller_arguments import describe_parameter
from fishd.cli.options import daemon_options
from fishd.cli.output import echo, make_printable, print_json
from fishd.core import text
from fishd.core.addresses import ENDPOINT_VARIABLE
from fishd.core.errors import NoDaemon, PolicyError, UnknownController
from fishd.core.protocol import PolicyInfo
from fishd.core.schema import names_file, suggest

T = TypeVar("T")

HEADER = (
    *("name", "observes", "Φ [rad]", "tick", "trained in", "steps", "relative thrust", "created"),
    "folder",
)
MAX_CELL_CHARACTERS = 40
"""Longest cell that is not cut, except in the last column [characters]."""


def _list_from_daemon(
    endpoint: str | None,
    ask: "Callable[[client.Fish], list[T]]",
    look: Callable[[], list[T]],
    noun: str,
) -> list[T]:
    """Return the list that the daemon gives, or that of this machine if no daemon runs.

    ask: gets the list from the daemon; look: gets it without one; noun: plural noun of its items
    """
    try:
        with client.Fish(endpoint) as fish:
            return ask(fish)
    except NoDaemon as error:
        if endpoint or os.environ.get(ENDPOINT_VARIABLE):
            raise
        echo(f"fishctl: {error.problem}; these are the {noun} of this machine", err=True)
        return look()


@click.command()
@click.argument("name", required=False, metavar="[NAME]")
@daemon_options
def controllers(name: str | None, endpoint: str | None, as_json: bool) -> None:
    """List the controllers that the daemon knows, or show the controller NAME.

    Each has its parameters, as options, and the quantities that it adds to telemetry.
    """
    from fishd.controllers import registry

    infos = _list_from_daemon(
        endpoint, client.Fish.controllers, registry.describe_all, "controllers"
    )
    if name is not None:
        names = [info.name for info in infos]
        infos = [info for info in infos if info.name == name]
        if not infos and name in registry.names():
            echo(f"fishctl: {name} was installed after fishd had started: restart fishd", err=True)
            infos = [registry.describe(name)]
        if not infos:
            hint = suggest(name, names)
            raise UnknownController(f"no controller is named '{name}'; {hint}")
    if as_json:
        print_json(infos)
        return
    for info in map(make_printable, infos):
        click.echo(f"{click.style(info.name, bold=True)}  {info.summary}")
        for field in info.parameters:
            echo(f"    --{field.name.replace('_', '-'):<22} {describe_parameter(field)}")
        for quantity in info.quantities:
            unit = "" if quantity.unit == "1" else f" [{quantity.unit}]"
            echo(f"    shows {quantity.name:<18} {quantity.description.rstrip('.')}{unit}")


class _PolicyGroup(click.Group):
    """Group in which the name of a policy means `show`, as in `fishctl controllers NAME`."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the verb, `show` if the first argument is not a verb, with its arguments."""
        if args and args[0] not in self.commands:
            args = ["show", *args]
        return super().resolve_command(ctx, args)


@click.group(cls=_PolicyGroup, invoke_without_command=True, subcommand_metavar="[NAME|FILE]")
@daemon_options
@click.pass_context
def policies(ctx: click.Context, endpoint: str | None, as_json: bool) -> None:
    """List the policies that have a name, or show one.

    A policy that sees forces swims with 'fishctl set-controller ppo --policy NAME', one that
    sees pictures with 'fishctl agent NAME'.
    Relative thrust is the share of the best square wave's thrust, as last evaluated in the
    training.
    """
    if ctx.invoked_subcommand:
        ctx.find_root().obj = endpoint
        return
    from fishd.controllers.policy import library

    infos = _list_policies(endpoint)
    if as_json:
        print_json(infos)
    elif infos:
        echo(_format_table(infos))
    else:
        echo(f"no policies here; put {library.SUFFIX} files into {library.folders()[0]}", err=True)


@policies.command()
@click.argument("policy", metavar="NAME|FILE")
@daemon_options
@click.pass_context
def show(ctx: click.Context, policy: str, endpoint: str | None, as_json: bool) -> None:
    """Print what a policy file says about its policy.

    This is its inputs, the robot and camera that it fits, and how it was trained.
    """
    from fishd.controllers.policy import library

    if names_file(policy, library.SUFFIX):
        policy_info = library.describe(policy)
    else:
        infos = {info.name: info for info in _list_policies(endpoint)}
        if policy not in infos:
            raise PolicyError(library.unknown_name_message(policy, sorted(infos)))
        policy_info = infos[policy]
    if policy_info.card is None:
        raise PolicyError(f"{policy_info.file}: {policy_info.problem}")
    if as_json or (ctx.parent and ctx.parent.params["as_json"]):
        print_json(policy_info)
    else:
        echo(_format_yaml(policy_info), nl=False)


def _list_policies(endpoint: str | None) -> list[PolicyInfo]:
    """Return the policies that the daemon finds, or those of this user and machine without one."""
    from fishd.controllers.policy import library

    return _list_from_daemon(endpoint, client.Fish.policies, library.describe_all, "policies")


def _format_table(infos: list[PolicyInfo]) -> str:
    rows = [HEADER, *(_format_row(info) for info in infos)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADER) - 1)]
    lines = []
    for row, info in zip(rows, (None, *infos), strict=True):
        cells = (f"{cell:<{width}}" for cell, width in zip(row, (*widths, 0), strict=True))
        lines.append("  ".join(cells).rstrip())
        if info and info.problem:
            lines.append(f"    not here: {text.line(info.problem)}")
    return "\n".join(lines)


def _format_row(info: PolicyInfo) -> tuple[str, ...]:
    folder = text.line(str(Path(info.file).parent))
    if info.card is None:
        return (text.line(info.name, MAX_CELL_CHARACTERS), *["–"] * (len(HEADER) - 2), folder)
    card: dict[str, Any] = info.card
    provenance = card["provenance"]
    relative_thrust = provenance.get("relative_thrust")
    cells = (
        info.name,
        info.inputs or "–",
        f"{card['amplitude']:g}",
        f"{card['tick'] * 1e3:g} ms",
        provenance["on"],
        str(provenance["steps"]),
        "–" if relative_thrust is None else f"{relative_thrust:.1%}",
        provenance["created"][:10],
        folder,
    )
    return (*(text.line(cell, MAX_CELL_CHARACTERS) for cell in cells[:-1]), folder)


def _format_yaml(info: PolicyInfo) -> str:
    import yaml

    head = {"name": info.name, "file": info.file}
    problem = {"problem": info.problem} if info.problem else {}
    # YAML escapes control characters of a file that may come from anywhere.
    return yaml.safe_dump(
        {**head, **problem, **(info.card or {})},
        sort_keys=False,
        allow_unicode=True,
    )
