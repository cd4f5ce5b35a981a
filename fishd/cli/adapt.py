"""The verb that makes a gait for a fish that nobody has seen."""

import contextlib
import shlex
from collections.abc import Iterator, Sequence
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec
from msgspec.structs import replace

from fishd.cli.config import set_option
from fishd.cli.lab_progress import showing
from fishd.cli.lease_options import take_option, verb_lease
from fishd.cli.options import FiniteRange, endpoint_option, json_option
from fishd.cli.output import echo, print_json
from fishd.cli.sweep import ON, refuse_other
from fishd.cli.sweep_output import again
from fishd.client import Fish
from fishd.config import Config, Start, adopt, check_tethered, load
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError
from fishd.core.process.interruption import interrupted_once

if TYPE_CHECKING:
    from fishd.lab.rig import Rig
    from fishd.learning.adapt.state import AdaptFolder, Contender, State

STEPS = 6400


@click.command()
@ON
@click.option(
    "--tank-time",
    type=FiniteRange(min=150.0, max=3600.0),
    default=300.0,
    show_default=True,
    help="For all that needs the fish, rests included [s]: a fifth of it excitation, a seventh the "
    "search of swing, a fifth that of square waves, the rest the comparison.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=640),
    default=STEPS,
    show_default=True,
    help="Of the training, in simulation, while the fish rests.",
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, help="Of cloud and training.")
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    help="Where everything goes; an adaptation that began there is resumed. [default: "
    "runs/adapt-DATE-TIME]",
)
@click.option(
    "--no-command",
    is_flag=True,
    help="On a robot: leave the fish at rest; without it, the chosen gait swims on.",
)
@click.option(
    "--config",
    "file",
    type=click.Path(path_type=Path, readable=False),
    help="In simulation: YAML file of the fish; without it, the defaults.",
)
@set_option
@endpoint_option
@take_option
@json_option
def adapt(
    on: str,
    tank_time: float,
    steps: int,
    seed: int,
    folder: Path | None,
    no_command: bool,
    file: Path | None,
    overrides: tuple[str, ...],
    endpoint: str | None,
    as_json: bool,
) -> int:
    """Find the best gait of a fish that nobody has seen, in five minutes of tank time.

    It swims excitation, and a fish is fitted to its forces. swing --C auto finds its C, and a
    search the best square wave. A policy is trained on the cloud of fish that the fit leaves
    possible. All three are measured on the fish, and the best one swims it from then on;
    where the measurement leaves that undecided, the simplest of those that may be it. Nothing is
    assumed of plant and rig, even if the configuration describes them.

    Ctrl-C lets the fish rest; the same command with the --folder goes on, and measures nothing
    again.
    """
    for package in ("onnxruntime", "tensorboard"):  # missing ones are named before the fish swims
        import_module(package)
    from fishd.lab import drawing
    from fishd.lab.begun import owned
    from fishd.learning.adapt import report
    from fishd.learning.adapt.adaptation import Adaptation
    from fishd.learning.adapt.state import AdaptFolder, Begun

    drawing.check_installed()
    refuse_other(on, {"--config": file, "--set": overrides}, {"--no-command": no_command or None})
    path = folder or Path("runs") / f"adapt-{datetime.now():%Y%m%d-%H%M%S}"
    with _fish(on, file, overrides, endpoint) as (rig, config, data, fish):
        if rig.unit != "N":
            raise FishdError(
                "the force sensor is not calibrated, so no force is known in newtons: "
                "fishctl calibrate force"
            )
        with owned(path, "adaptation"):
            run = AdaptFolder(path, Begun(on, steps, seed, data))
            try:
                with (
                    interrupted_once(),
                    rig,
                    showing(tank_time, "s of tank time", err=as_json) as show,
                ):
                    state = Adaptation(rig, config, run, tank_time, steps, seed, show).run()
                    words = command_of(_chosen(state), on, file, overrides, endpoint)
                    files = report.write(run, rig.amplitude, words)
            except KeyboardInterrupt:
                kept = f"{run.state.tank_time:.0f} s of tank time are kept"
                echo(f"fishctl: stopped; {kept}; to go on: {again(path)}", err=True)
                return INTERRUPTED
            except FishdError as error:
                error.args = (f"{error}; {_kept(run)}{again(path)}",)
                raise
        if as_json:
            print_json(msgspec.to_builtins(state))
        else:
            _say(state)
            echo(f"report: {files[1]}, picture: {files[0]}")
        chosen = _chosen(state)
        if fish and not no_command:
            fish.set_controller(chosen.controller, **chosen.parameters)
            echo(f"{chosen.name} swims the fish now; to have it again: {words}", err=as_json)
        else:
            echo(f"to have it again: {words}", err=as_json)
    return 0


@contextlib.contextmanager
def _fish(
    on: str, file: Path | None, overrides: tuple[str, ...], endpoint: str | None
) -> "Iterator[tuple[Rig, Config, dict[str, Any], Fish | None]]":
    """What swims, its configuration, the same as plain data, and the fishd that it is of."""
    from fishd.lab.rig import LiveRig, VirtualRig

    if on == "simulation":
        config = replace(load(file, overrides), start=Start())
        check_tethered(config.robot, "adapt")
        yield VirtualRig(config), config, msgspec.to_builtins(config), None
        return
    with Fish(endpoint) as fish:
        rig = LiveRig(fish, *verb_lease())
        data = fish.config()
        yield rig, adopt(fish.config()), data, fish


def _chosen(state: "State") -> "Contender":
    assert state.verdict
    return next(one for one in state.contenders if one.name == state.verdict.chosen)


def _kept(run: "AdaptFolder") -> str:
    """Before the command that goes on."""
    used = run.state.tank_time
    return f"{used:.0f} s of tank time are kept; to go on: " if used else "to begin again: "


def command_of(
    one: "Contender",
    on: str,
    file: Path | None = None,
    overrides: Sequence[str] = (),
    endpoint: str | None = None,
) -> str:
    """Return the command line that lets a gait swim the same fish.

    file, overrides: configuration of a simulated one; endpoint: of the fishd of another one
    """
    words = ["fishctl", "set-controller" if on == "robot" else "simulate", one.controller]
    for name, value in one.parameters.items():
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        words += [f"--{name.replace('_', '-')}", shown]
    words += ["--config", str(file)] if file else []
    words += [word for text in overrides for word in ("--set", text)]
    words += ["--endpoint", endpoint] if endpoint else []
    return shlex.join(words)


def _say(state: "State") -> None:
    assert state.verdict
    echo(f"{state.verdict.claim[0].upper()}{state.verdict.claim[1:]}.")
    for one in state.contenders:
        if one.true_thrust is not None:
            echo(
                f"{one.name}: truly {1e3 * one.true_thrust:.2f} mN, "
                f"{one.true_relative_thrust:.1%} of "
                "the best of all square waves"
            )
    echo(f"{state.tank_time:.0f} s of tank time")
