"""Verbs that talk to a running daemon: controllers, policies, set-controller, stop and so on."""

import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click

from fishd import client
from fishd.cli.completion import active_parameters, complete_pair
from fishd.cli.options import (
    ControllerGroup,
    ParameterType,
    Utf8Text,
    daemon_options,
    describe_parameter,
)
from fishd.cli.output import echo, format_state, make_printable, print_json
from fishd.cli.plausibility import running_config, warn_of_values
from fishd.core import text
from fishd.core.addresses import ENDPOINT_VARIABLE
from fishd.core.errors import NoDaemon, PolicyError, UnknownController
from fishd.core.protocol import PolicyInfo, State
from fishd.core.schema import Field, names_file, suggest

T = TypeVar("T")
HEADER = (
    *("name", "sees", "Φ [rad]", "tick", "trained in", "steps", "relative thrust", "created"),
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
    except NoDaemon:
        if endpoint or os.environ.get(ENDPOINT_VARIABLE):
            raise
        echo(f"fishctl: no fishd is running; these are the {noun} of this machine", err=True)
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
        if name not in names:
            hint = suggest(name, names)
            raise UnknownController(f"no controller is named '{name}'; {hint}")
        infos = [info for info in infos if info.name == name]
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


@click.group(cls=ControllerGroup, options=daemon_options, remote=True)
def set_controller() -> None:
    """Let another controller swim; parameters left out take their defaults."""


@set_controller.action
def _set_controller(
    name: str, parameters: dict[str, Any], endpoint: str | None, as_json: bool
) -> None:
    _change(endpoint, as_json, lambda fish: fish.set_controller(name, **parameters))


@click.command(context_settings={"ignore_unknown_options": True})  # -1 is a value
@click.argument(
    "words",
    nargs=-1,
    required=True,
    metavar="NAME VALUE|NAME=VALUE...",
    shell_complete=complete_pair,
)
@daemon_options
def set_parameter(words: tuple[str, ...], endpoint: str | None, as_json: bool) -> None:
    """Change parameters of the running controller while the fish swims, all or none of them."""
    pairs = list(_parse_pairs(words))

    def change(fish: client.Fish) -> State:
        fields = active_parameters(fish)
        # The daemon refuses a name that the controller does not have, and says which it has.
        values = {
            name: _convert_value(fields[name], text) if name in fields else text
            for name, text in pairs
        }
        state = fish.set_parameters(**values)
        warn_of_values(fields.values(), values, partial(running_config, fish))
        return state

    _change(endpoint, as_json, change)


def _convert_value(field: Field, text: str) -> Any:
    try:
        return ParameterType(field).convert(text, None, None)
    except click.BadParameter as error:
        error.param_hint = f"'{field.name}'"
        raise


def _parse_pairs(words: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield names and values of `NAME VALUE`, `NAME=VALUE` and `--NAME VALUE`, in any mixture."""
    remaining, names = iter(words), set[str]()
    for word in remaining:
        name, equals, text = word.partition("=")
        value = text if equals else next(remaining, None)
        if value is None:
            raise click.UsageError(f"every NAME needs a VALUE, such as: {name} 0.7, or {name}=0.7")
        name = name.lstrip("-").replace("-", "_")
        if name in names:
            raise click.UsageError(f"{name} is given twice")
        names.add(name)
        yield name, value


@click.command()
@daemon_options
def stop(endpoint: str | None, as_json: bool) -> None:
    """Fade to neutral and stay there."""
    _change(endpoint, as_json, client.Fish.stop)


@click.command()
@daemon_options
def clear_fault(endpoint: str | None, as_json: bool) -> None:
    """Leave mode fault or estop; the servo gets pulses again and goes to neutral."""
    _change(endpoint, as_json, client.Fish.clear_fault)


@click.command()
@click.argument("words", metavar="TEXT", type=Utf8Text())
@daemon_options
def mark(words: str, endpoint: str | None, as_json: bool) -> None:
    """Put a mark in the event stream, such as what you just changed on the rig."""
    with client.Fish(endpoint) as fish:
        state = fish.mark(words)
    if as_json:
        print_json(state)
    else:
        echo(f"marked before tick {state.seq}: {words}")


def _change(endpoint: str | None, as_json: bool, change: "Callable[[client.Fish], State]") -> None:
    """Request a change, and print the state afterwards."""
    with client.Fish(endpoint) as fish:
        state = change(fish)
    if as_json:
        print_json(state)
        return
    echo(format_state(state))
    if holder := state.took_from:
        previous = make_printable(holder)
        echo(
            f"fishctl: took the fish from {previous}, which had it for {holder.age:.0f} s", err=True
        )


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
    """Print what a policy file says about itself.

    Its inputs, what it fits, and how it was trained.
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
