"""The verb `fishctl adapt`, which finds a gait for a fish that was never measured before."""

import shlex
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec

from fishd.cli.experiment_options import (
    ChosenFish,
    ExperimentEnding,
    ExperimentFolder,
    Resumable,
    fish_choice,
    folder_options,
)
from fishd.cli.options import FiniteRange, json_option, plot_option, seed_option
from fishd.cli.output import echo, print_json
from fishd.cli.progress import show_progress
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.learning.adapt.state import Contender, State

DEFAULT_STEPS = 6400


@click.command(cls=Resumable)
@click.option(
    "--budget",
    type=FiniteRange(min=150.0, max=3600.0),
    metavar="SECONDS",
    default=300.0,
    show_default=True,
    help="Largest tank time, rests included [s]: a fifth for the excitation, a seventh for the "
    "search of swing, a fifth for that of square waves, the rest for the comparison.",
)
@click.option(
    "--steps",
    type=click.IntRange(min=640),
    default=DEFAULT_STEPS,
    show_default=True,
    help="Control steps of the training, which runs in simulation while the fish rests.",
)
@seed_option("the cloud of models and of the training")
@click.option(
    "--no-command",
    is_flag=True,
    help="Live: leave the fish at rest at the end. [default: swim the chosen gait]",
)
@fish_choice
@folder_options
@plot_option("fit, search, training and comparison")
@json_option
def adapt(
    budget: float,
    steps: int,
    seed: int,
    no_command: bool,
    fish: ChosenFish,
    place: ExperimentFolder,
    picture: Path | None,
    as_json: bool,
) -> int:
    """Find the best gait of an unknown fish, in five minutes of tank time.

    The fish first swims an excitation, and a model is fitted to its forces. swing --C auto finds
    its C, and a search finds the best square wave. A policy is trained on the cloud of models that
    agree with the fit. All three gaits are measured on the fish, and it swims the best one
    from then on. If the measurement does not decide, it swims the simplest of the gaits that may
    be the best. The search does not use the sections plant and simulation of the configuration.

    Ctrl-C lets the fish rest; --resume continues without repeating measurements.
    """
    for package in (
        "onnxruntime",
        "tensorboard",
    ):  # raises for a missing package before the fish swims
        import_module(package)
    from fishd.lab import drawing
    from fishd.lab.session import LiveSession
    from fishd.learning.adapt import report
    from fishd.learning.adapt.adaptation import Adaptation, add_true_thrusts
    from fishd.learning.adapt.state import PICTURE, AdaptFolder

    drawing.check(picture or PICTURE)
    fish.refuse_other({}, {"--no-command": no_command})
    settings = {"steps": steps, "seed": seed}
    with fish.session() as session:
        session.check_calibrated()
        with place.open(fish, settings, session) as experiment:
            run = AdaptFolder(experiment)
            ending = ExperimentEnding(experiment)
            fish.announce(as_json)
            with (
                ending.measuring(FishdError),
                session,
                show_progress(budget, "s of tank time", err=as_json) as show,
            ):
                state = Adaptation(session, run, budget, steps, seed, show).run()
            if ending.is_interrupted:
                return ending.interrupted(f"{run.state.tank_time:.0f} s of tank time are kept")
            if fish.on == "simulation":
                add_true_thrusts(run, fish.load())
            words = format_command(_chosen_gait(state), fish)
            files = report.write(run, session.amplitude, words)
            if picture:
                report.draw(run, session.amplitude, picture)
        if as_json:
            print_json(msgspec.to_builtins(state))
        else:
            _print_state(state)
            echo(f"report: {files[1]}, picture: {files[0]}")
        chosen = _chosen_gait(state)
        if isinstance(session, LiveSession) and not no_command:
            session.fish.set_controller(chosen.controller, **chosen.parameters)
            echo(f"{chosen.name} swims the fish now; to swim it again: {words}", err=as_json)
        else:
            echo(f"to swim it again: {words}", err=as_json)
    return 0


def _chosen_gait(state: "State") -> "Contender":
    assert state.verdict
    return next(
        contender for contender in state.contenders if contender.name == state.verdict.chosen_gait
    )


def format_command(gait: "Contender", fish: ChosenFish) -> str:
    """Return the command line that swims the same fish with a gait."""
    from fishd.learning.adapt.report import gait_words

    verb = "set-controller" if fish.on == "live" else "simulate"
    words = ["fishctl", verb, *gait_words(gait)]
    words += ["--config", str(fish.file)] if fish.file else []
    words += [word for text in fish.overrides for word in ("--set", text)]
    words += ["--endpoint", fish.endpoint] if fish.endpoint else []
    return shlex.join(words)


def _print_state(state: "State") -> None:
    assert state.verdict
    echo(f"{state.verdict.claim[0].upper()}{state.verdict.claim[1:]}.")
    for contender in state.contenders:
        if contender.true_thrust is not None:
            echo(
                f"{contender.name}: truly {1e3 * contender.true_thrust:.2f} mN, "
                f"{contender.true_relative_thrust:.1%} of the best of all square waves"
            )
    echo(f"{state.tank_time:.0f} s of tank time")
