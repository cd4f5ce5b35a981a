"""The verb that lists the named policies, and shows what a policy file says about itself."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.control import list_from_daemon
from fishd.cli.options import daemon_options
from fishd.cli.output import echo, print_json
from fishd.client import Fish
from fishd.controllers.policy import library
from fishd.core import text
from fishd.core.errors import PolicyError
from fishd.core.protocol import PolicyInfo
from fishd.core.schema import names_file

HEADER = (
    *("name", "sees", "Φ [rad]", "tick", "trained in", "steps", "relative thrust", "created"),
    "folder",
)
MAX_CELL_CHARACTERS = 40
"""Longest cell that is not cut, except in the last column [characters]."""


@click.group(invoke_without_command=True)
@daemon_options
@click.pass_context
def policies(ctx: click.Context, endpoint: str | None, as_json: bool) -> None:
    """List the policies that have a name.

    A policy that sees forces swims with 'fishctl set-controller ppo --policy NAME', one that
    sees pictures with 'fishctl agent NAME'.
    Relative thrust is the share of the best square wave's thrust, as last evaluated in the
    training.
    """
    if ctx.invoked_subcommand:
        ctx.find_root().obj = endpoint
        return
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
    """Print what a policy file says about itself.

    Its inputs, what it fits, and how it was trained.
    """
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
    return list_from_daemon(endpoint, Fish.policies, library.describe_all, "policies")


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
        info.sees or "–",
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
