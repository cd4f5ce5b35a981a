"""`fishctl estop`: ends the pulses through fishd, or without it if it does not answer."""

import signal
from pathlib import Path
from typing import Any

import click
import msgspec

from fishd.cli.options import daemon_options
from fishd.cli.output import echo, format_state, output_may_fail, print_json
from fishd.client import Fish
from fishd.core import addresses
from fishd.core.addresses import socket_path
from fishd.core.errors import FishError, NoDaemon, Refused, StartupError, Untrusted
from fishd.core.process.interruption import SIGNALS, handle_signals
from fishd.core.protocol import State
from fishd.hardware import release_recipe

_TIMEOUT_S = 0.1
"""Longest further wait for an answer, if neither socket has answered at once [s]."""


@click.command()
@click.argument("message", default="requested with fishctl")
@click.option(
    "--config",
    "file",
    type=click.Path(path_type=Path, readable=False),
    help="YAML file of the daemon, for the last resort. [default: the file that the daemon "
    "wrote for this, else as for release]",
)
@daemon_options
def estop(message: str, file: Path | None, endpoint: str | None, as_json: bool) -> int:
    """Emergency stop: no more pulses, at once, until 'fishctl clear-fault'.

    It tries four ways, and prints which one worked: fishd's control socket; fishd's separate
    socket for emergency stops, if the first does not answer within 0.1 s; fishd's name in the
    kernel, which needs no file; and the last resort without the daemon, as 'fishctl release'. Exit
    status 0 if there are no more pulses.
    """
    with Fish(endpoint) as fish:
        path = socket_path(fish.endpoint)
        try:
            state = fish.estop(message, timeout=_TIMEOUT_S if path else None)
        except (Refused, Untrusted):
            raise
        except FishError as no_answer:
            way, summary = "last resort", _end_pulses(no_answer, fish.endpoint, file)
            answer: dict[str, Any] = {"pulses": summary}
        else:
            way, summary = _describe_way(fish, path), format_state(state)
            answer = _to_builtins(state)
    with output_may_fail(summary):
        if as_json:
            print_json({"way": way, **answer})
        else:
            echo(f"{summary}\nstopped through: {way}")
    return 0


def _describe_way(fish: Fish, path: Path | None) -> str:
    if fish.estop_taken_by == "control":
        return f"control socket; {fish.detour}" if fish.detour else "control socket"
    if fish.estop_taken_by == "kernel":
        return f"fishd's name in the kernel: {fish.detour}"
    return f"fishd's own socket, {path}.estop, as the control socket did not answer at once"


def _to_builtins(state: State) -> dict[str, Any]:
    builtins: dict[str, Any] = msgspec.to_builtins(state)
    return builtins


def _end_pulses(no_answer: FishError, endpoint: str, file: Path | None) -> str:
    """End the pulses without the daemon; return what was done, in words."""
    path = socket_path(endpoint)
    recipe = release_recipe.read(str(path)) if path and not file else None
    if recipe is None:
        if not file and not addresses.is_own(endpoint):
            raise NoDaemon(
                f"{no_answer}; nothing was released: the servo is that of another machine, so run "
                "fishctl estop there"
            )
        from fishd.cli.release import release_by_config

        return release_by_config(no_answer, file)
    if not recipe["function"]:
        return f"no pulses: the fish is simulated, and its fishd does not answer ({no_answer})"
    try:
        with handle_signals(SIGNALS, signal.SIG_IGN):  # it must not end halfway
            result = release_recipe.carry_out(
                recipe["function"], recipe["neutral"], recipe["arguments"]
            )
    except (StartupError, ImportError, OSError) as error:
        raise click.ClickException(f"{error}; {release_recipe.NOT_RELEASED}") from None
    return release_recipe.describe_outcome(result)
