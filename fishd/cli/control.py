"""Verbs that talk to a running daemon: set-controller, stop and so on."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import click

from fishd import client
from fishd.cli.completion import active_parameters, complete_pair
from fishd.cli.controller_arguments import ControllerGroup, ParameterType
from fishd.cli.options import Utf8Text, daemon_options
from fishd.cli.output import echo, format_state, make_printable, print_json, report_detour
from fishd.cli.plausibility import running_config, warn_of_values
from fishd.core.errors import Refused
from fishd.core.protocol import State
from fishd.core.schema import Field


@click.group(cls=ControllerGroup, options=daemon_options, remote=True)
def set_controller() -> None:
    """Set the controller of the fish; parameters left out take their defaults."""


@set_controller.action
def _set_controller(
    name: str, parameters: dict[str, Any], endpoint: str | None, as_json: bool
) -> None:
    def start(fish: client.Fish) -> State:
        try:
            return fish.set_controller(name, **parameters)
        except Refused as error:
            if error.code != "unknown-controller":
                raise
            # This machine has it, so it was probably installed after fishd had started.
            raise Refused(
                error.code, f"{error}; if {name} was installed since, restart fishd"
            ) from None

    _change(endpoint, as_json, start)


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
@daemon_options
def restart(endpoint: str | None, as_json: bool) -> None:
    """Let systemd restart the daemon, which then reads its configuration again.

    Refused while the fish swims or an experiment has it, and if the configuration is wrong.
    """
    _change(endpoint, as_json, client.Fish.restart)


@click.command()
@click.argument("words", metavar="TEXT", type=Utf8Text())
@daemon_options
def mark(words: str, endpoint: str | None, as_json: bool) -> None:
    """Write a mark into the event stream, such as what you have changed on the rig."""
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
    report_detour(fish)
    if as_json:
        print_json(state)
        return
    echo(format_state(state))
    if state.cancelled:
        name = make_printable(state).cancelled
        echo(f"fishctl: {name}, the controller of 'start', does not start any more", err=True)
    if holder := state.previous_holder:
        previous = make_printable(holder)
        echo(
            f"fishctl: took the fish from {previous}, which had it for {holder.age:.0f} s", err=True
        )
