"""`fishctl estop`: ends the pulses through fishd, or without it if it does not answer."""

import os
import signal
import socket
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import click
import msgspec

from fishd.cli.options import daemon_options
from fishd.cli.output import echo, format_state, output_may_fail, print_json
from fishd.client import Fish
from fishd.core.addresses import Ipc, parse, socket_path
from fishd.core.errors import FishError, NoDaemon, Refused, StartupError, Untrusted
from fishd.core.local_daemons import LocalDaemon, become
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
            way, summary = "last resort", _end_pulses(fish, path, file, no_answer)
            answer: dict[str, Any] = {"pulses": summary}
        else:
            way, summary = _describe_way(fish, path), format_state(state)
            answer = _to_builtins(state)
            if recipes := _find_recipes(fish.silent):
                pids = " and ".join(str(daemon.pid) for daemon in fish.silent)
                summary += f"; of process {pids}, which does not answer: {_carry_out(recipes)}"
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


def _end_pulses(fish: Fish, path: Path | None, file: Path | None, no_answer: FishError) -> str:
    """End the pulses without the daemon; return what was done, in words."""
    problem = no_answer.problem if isinstance(no_answer, NoDaemon) else str(no_answer)
    if not file:
        recipes = _find_recipes(fish.silent)
        if path and (own := release_recipe.read(str(path))):
            recipes.append(own)
        if recipes:
            return _carry_out({recipe["config"]: recipe for recipe in recipes}.values())
        if not _is_of_this_machine(fish.endpoint):
            raise NoDaemon(
                f"{problem}; nothing was released: the servo is that of another machine, so run "
                "fishctl estop there"
            )
    from fishd.cli.release import release_by_config

    for daemon in fish.silent:
        if daemon.user != os.geteuid():
            problem += f"; for process {daemon.pid}, run: {become(daemon.user)}fishctl estop"
    return release_by_config(problem, file)


def _is_of_this_machine(endpoint: str) -> bool:
    """Return whether an endpoint leads to this machine, as far as the addresses of it say."""
    try:
        address = parse(endpoint)
        if isinstance(address, Ipc):
            return True
        places = socket.getaddrinfo(address.host, None, type=socket.SOCK_DGRAM)
    except (OSError, ValueError):
        return False
    for family, kind, _, _, place in places:
        with suppress(OSError), socket.socket(family, kind) as probe:
            probe.bind(place)  # fails for an address of another machine
            return True
    return False


def _find_recipes(daemons: Iterable[LocalDaemon]) -> list[dict[str, Any]]:
    """Return the recipes that these fishds have left."""
    if not daemons:
        return []
    from fishd.hardware.recipes import find_recipe

    return [recipe for daemon in daemons if (recipe := find_recipe(daemon))]


def _carry_out(recipes: Iterable[dict[str, Any]]) -> str:
    """End the pulses by all of these; return what was done, in words."""
    done, failures = [], []
    with handle_signals(SIGNALS, signal.SIG_IGN):  # it must not end halfway
        for recipe in recipes:
            function, neutral, arguments = (
                recipe[key] for key in ("function", "neutral", "arguments")
            )
            try:
                done.append(
                    release_recipe.describe_outcome(
                        release_recipe.carry_out(function, neutral, arguments)
                    )
                    if function
                    else "no pulses: the fish is simulated, and its fishd does not answer"
                )
            except (StartupError, ImportError, OSError) as error:
                failures.append(str(error))
    if failures:
        raise click.ClickException(f"{'; '.join(failures)}; {release_recipe.NOT_RELEASED}")
    return "; ".join(done)
