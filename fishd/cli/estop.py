"""`fishctl estop`: the end of the pulses, by whichever way there is."""

import signal
from pathlib import Path
from typing import Any

import click
import msgspec

from fishd.cli.options import daemon_options
from fishd.cli.output import echo, output_may_fail, print_json, state_line
from fishd.client import Fish
from fishd.core.addresses import socket_path
from fishd.core.errors import NoDaemon, StartupError, Untrusted
from fishd.core.process.interruption import SIGNALS, handled
from fishd.core.protocol import State
from fishd.hardware import release_recipe

_TIMEOUT_S = 0.3
"""Longest further time for an answer, once neither socket has answered at once [s]."""


@click.command()
@click.argument("message", default="requested with fishctl")
@click.option(
    "--config",
    "file",
    type=click.Path(path_type=Path, readable=False),
    help="YAML file of the daemon, for the last resort; by default what the daemon has left, else "
    "as for release.",
)
@daemon_options
def estop(message: str, file: Path | None, endpoint: str | None, as_json: bool) -> int:
    """Emergency stop: no more pulses, at once, until 'fishctl clear-fault'.

    Says which way it took: the control socket; or fishd's own socket for emergency stops, where
    the first does not answer within 0.1 s; or the last resort without the daemon, as 'fishctl
    release'. Exit status 0 where there are no more pulses.
    """
    with Fish(endpoint) as fish:
        path = socket_path(fish.endpoint)
        try:
            state = fish.estop(message, timeout=_TIMEOUT_S if path else None)
        except Untrusted:
            raise
        except NoDaemon as silence:
            way, said = "last resort", _end_pulses(silence, path, file)
            answer: dict[str, Any] = {"pulses": said}
        else:
            way, said = _way(fish, path), state_line(state)
            answer = _builtins(state)
    with output_may_fail(said):
        if as_json:
            print_json({"way": way, **answer})
        else:
            echo(f"{said}\nway: {way}")
    return 0


def _way(fish: Fish, path: Path | None) -> str:
    if fish.estop_taken_by == "control":
        return "control socket"
    return f"fishd's own socket, {path}.estop, as the control socket did not answer at once"


def _builtins(state: State) -> dict[str, Any]:
    builtins: dict[str, Any] = msgspec.to_builtins(state)
    return builtins


def _end_pulses(silence: NoDaemon, path: Path | None, file: Path | None) -> str:
    """End the pulses without the daemon; returns what was done, in words."""
    recipe = release_recipe.read(str(path)) if path and not file else None
    if recipe is None:
        from fishd.cli.release import release_by_config

        return release_by_config(silence, file)
    if not recipe["function"]:
        return f"no pulses: the fish is simulated, and its fishd does not answer ({silence})"
    try:
        with handled(SIGNALS, signal.SIG_IGN):  # nothing ends it halfway
            done = release_recipe.carry_out(
                recipe["function"], recipe["neutral"], recipe["arguments"]
            )
    except (StartupError, ImportError, OSError) as error:
        raise click.ClickException(f"{error}; {release_recipe.NOT_RELEASED}") from None
    return release_recipe.outcome(done)
