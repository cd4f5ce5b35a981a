"""The verb `fishctl adapt`, which finds a gait for a fish that was never measured before."""

import shlex
from importlib import import_module
from typing import TYPE_CHECKING

import click
import msgspec

from fishd.cli.experiment import (
    LIVE,
    MEASURED_TAIL,
    ChosenFish,
    Resumable,
    Run,
    experiment_options,
)
from fishd.cli.options import FiniteRange, seed_option
from fishd.cli.output import echo

if TYPE_CHECKING:
    from fishd.lab.compare.comparison import Standing
    from fishd.learning.adapt.results import Adapted

DEFAULT_STEPS = 6400


@click.command(cls=Resumable)
@experiment_options(
    click.option(
        "--budget",
        type=FiniteRange(min=150.0, max=3600.0),
        metavar="SECONDS",
        default=300.0,
        show_default=True,
        help="Largest tank time, rests included [s]: a fifth for the excitation, a seventh for "
        "the search of swing, a fifth for that of square waves, the rest for the comparison.",
    ),
    click.option(
        "--steps",
        type=click.IntRange(min=640),
        default=DEFAULT_STEPS,
        show_default=True,
        help="Control steps of the training, which runs in simulation while the fish rests.",
    ),
    seed_option("the cloud of models and of the training"),
    click.option(
        "--no-command",
        is_flag=True,
        help="leave the fish at rest at the end. [default: swim the chosen gait]",
        **LIVE,
    ),
    tail=MEASURED_TAIL,
    plot="command, fin, force and thrust of each gait",
    keeps_simulations=True,
)
def adapt(budget: float, steps: int, seed: int, no_command: bool, run: Run) -> None:
    """Find the best gait of an unknown fish, in five minutes of tank time.

    The fish first swims an excitation, and a model is fitted to its forces. swing --C auto finds
    its C, and a search finds the best square wave. A policy is trained on the cloud of models that
    agree with the fit. All three gaits are measured on the fish, and it swims the best one
    from then on. If the measurement does not decide, it swims the simplest of the gaits that may
    be the best. The search does not use the sections plant and simulation of the configuration.

    Ctrl-C lets the fish rest; --resume continues without repeating measurements.
    """
    for package in ("onnxruntime", "tensorboard"):  # before the fish swims
        import_module(package)
    from fishd.lab.error_budget import estimate_thrust
    from fishd.lab.session import LiveSession

    session = run.session()
    session.check_calibrated()
    run.end_dry_run(budget, "s", budget if run.fish.on == "live" else None)
    from fishd.learning.adapt import adaptation  # imports torch

    run.open({"budget": budget, "steps": steps, "seed": seed})
    with run.swimming(budget, "s of tank time") as show:
        paths = run.pictures("gaits")
        adapted = adaptation.adapt(session, run.experiment, budget, steps, seed, show, paths)
    run.check(f"{session.used:.0f} s of tank time are kept")
    if run.fish.on == "simulation":
        adapted = adaptation.add_true_thrusts(adapted, run.fish.load())
    chosen = adapted.chosen
    summary = {"summary": " ".join(["chosen:", *gait_words(chosen)])}
    measured = {name: getattr(chosen, name) for name in ("thrust", "thrust_ci95", "total_ci95")}
    run.show(
        adapted,
        lambda: _print_result(adapted),
        kept=msgspec.to_builtins(adapted) | measured | summary,
        estimates=[estimate_thrust(gait.contestant, gait, session.unit) for gait in adapted.gaits],
        headline=f"Verdict: {adapted.verdict}.",
    )
    run.echo_pictures(paths)
    again = f"to swim it again: {format_command(chosen, run.fish)}"
    if isinstance(session, LiveSession) and not no_command:
        session.fish.set_controller(chosen.controller, **chosen.parameters)
        again = f"{chosen.contestant} swims the fish now; {again}"
    run.echo(again)


def gait_words(gait: "Standing") -> list[str]:
    """Return a gait as fishctl takes it: its controller, and its parameters as options."""
    words = [gait.controller]
    for name, value in gait.parameters.items():
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        words += [f"--{name.replace('_', '-')}", shown]
    return words


def format_command(gait: "Standing", fish: ChosenFish) -> str:
    """Return the command line that swims the same fish with a gait."""
    verb = "set-controller" if fish.on == "live" else "simulate"
    words = ["fishctl", verb, *gait_words(gait)]
    words += ["--config", str(fish.file)] if fish.file else []
    words += [word for text in fish.overrides for word in ("--set", text)]
    words += ["--endpoint", fish.endpoint] if fish.endpoint else []
    return shlex.join(words)


def _print_result(adapted: "Adapted") -> None:
    echo(f"Verdict: {adapted.verdict}.")
    for name, thrust in adapted.true_thrusts.items():
        share = adapted.true_relative_thrusts[name]
        echo(f"{name}: truly {1e3 * thrust:.2f} mN, {share:.1%} of the best of all square waves")
    echo(f"{adapted.tank_time:.0f} s of tank time")
