"""The verb that makes a gait for a fish that was never measured before."""

import shlex
from importlib import import_module
from typing import TYPE_CHECKING

import click
import msgspec

from fishd.cli.experiment_options import (
    ChosenFish,
    Ending,
    Place,
    Resumable,
    fish_choice,
    folder_options,
)
from fishd.cli.options import FiniteRange, json_option, seed_option
from fishd.cli.output import echo, print_json
from fishd.cli.progress import show_progress
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.learning.adapt.state import Contender, State

STEPS = 6400


@click.command(cls=Resumable)
@click.option(
    "--budget",
    type=FiniteRange(min=150.0, max=3600.0),
    metavar="SECONDS",
    default=300.0,
    show_default=True,
    help="Largest tank time, rests included [s]: a fifth of it excitation, a seventh the "
    "search of swing, a fifth that of square waves, the rest the comparison.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=640),
    default=STEPS,
    show_default=True,
    help="Control steps of the training, in simulation, while the fish rests.",
)
@seed_option("cloud and training")
@click.option(
    "--no-command",
    is_flag=True,
    help="Live: leave the fish at rest; without it, the chosen gait swims on.",
)
@fish_choice
@folder_options
@json_option
def adapt(
    budget: float,
    steps: int,
    seed: int,
    no_command: bool,
    fish: ChosenFish,
    place: Place,
    as_json: bool,
) -> int:
    """Find the best gait of a fish that nobody has seen, in five minutes of tank time.

    It swims excitation, and a fish is fitted to its forces. swing --C auto finds its C, and a
    search the best square wave. A policy is trained on the cloud of fish that the fit leaves
    possible. All three are measured on the fish, and the best one swims it from then on;
    where the measurement leaves that undecided, the simplest of those that may be it. Nothing is
    assumed of plant and rig, even if the configuration describes them.

    Ctrl-C lets the fish rest; --resume goes on, and measures nothing again.
    """
    for package in ("onnxruntime", "tensorboard"):  # missing ones are named before the fish swims
        import_module(package)
    from fishd.lab import drawing
    from fishd.lab.session import LiveSession
    from fishd.learning.adapt import report
    from fishd.learning.adapt.adaptation import Adaptation
    from fishd.learning.adapt.state import AdaptFolder

    drawing.check_installed()
    fish.refuse_other({}, {"--no-command": no_command})
    settings = {"steps": steps, "seed": seed}
    with fish.session() as session:
        session.check_calibrated()
        with place.open(fish, session.config, settings) as experiment:
            run = AdaptFolder(experiment)
            ending = Ending(experiment)
            fish.announce(as_json)
            with (
                ending.measuring(FishdError),
                session,
                show_progress(budget, "s of tank time", err=as_json) as show,
            ):
                state = Adaptation(session, run, budget, steps, seed, show).run()
                words = command_of(_chosen(state), fish)
                files = report.write(run, session.amplitude, words)
            if ending.is_interrupted:
                return ending.interrupted(f"{run.state.tank_time:.0f} s of tank time are kept")
        if as_json:
            print_json(msgspec.to_builtins(state))
        else:
            _print(state)
            echo(f"report: {files[1]}, picture: {files[0]}")
        chosen = _chosen(state)
        if isinstance(session, LiveSession) and not no_command:
            session.fish.set_controller(chosen.controller, **chosen.parameters)
            echo(f"{chosen.name} swims the fish now; to swim it again: {words}", err=as_json)
        else:
            echo(f"to swim it again: {words}", err=as_json)
    return 0


def _chosen(state: "State") -> "Contender":
    assert state.verdict
    return next(one for one in state.contenders if one.name == state.verdict.chosen)


def command_of(gait: "Contender", fish: ChosenFish) -> str:
    """Return the command line with which a gait swims the same fish."""
    verb = "set-controller" if fish.on == "live" else "simulate"
    words = ["fishctl", verb, gait.controller]
    for name, value in gait.parameters.items():
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        words += [f"--{name.replace('_', '-')}", shown]
    words += ["--config", str(fish.file)] if fish.file else []
    words += [word for text in fish.overrides for word in ("--set", text)]
    words += ["--endpoint", fish.endpoint] if fish.endpoint else []
    return shlex.join(words)


def _print(state: "State") -> None:
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
