"""The verb that trains a policy with PPO."""

import statistics
import threading
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
from msgspec import to_builtins
from msgspec.structs import replace

from fishd.cli.config import config_option, set_option
from fishd.cli.experiment import Ending
from fishd.cli.experiment_options import (
    On,
    default_on,
    dry_run_option,
    end_dry_run,
    kept_arguments,
    on_option,
    restore_arguments,
)
from fishd.cli.options import (
    camera_config_option,
    endpoint_option,
    json_option,
    plot_option,
    seed_option,
    take_option,
    verb_lease,
)
from fishd.cli.output import echo, print_json
from fishd.cli.progress import report_progress, show_progress
from fishd.config import adopt, load
from fishd.core.console import INTERRUPTED
from fishd.core.errors import ConfigError
from fishd.core.experiments import Plan, Progress
from fishd.core.process.interruption import Interrupted, on_signal

if TYPE_CHECKING:
    from fishd.learning.train.jobs import Job, Outcome

MAX_RELATIVE_THRUST = 1.03
"""Largest plausible relative thrust; above it the measurement is wrong."""
_KIND = "learn ppo"
BY_RESUME = "with --resume, which keeps the options of the run"


def _read_command(_: click.Context, folder: Path) -> list[str]:
    """Return the arguments of a training with several seeds; none for another folder."""
    from fishd.lab.experiment import HEADER, read_header

    header = read_header(folder) if (folder / HEADER).exists() else None
    words = header.command if header and header.kind == _KIND else []
    return words if any(word.partition("=")[0] == "--seeds" for word in words) else []


class _Training(click.Command):
    """Verb for which `--resume` restores the options of a training with several seeds."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments after those of the resumed training."""
        return super().parse_args(ctx, restore_arguments(ctx, args, _read_command))


@click.command(cls=_Training)
@on_option
@config_option("Configuration of the fish. [default: the defaults; live, that of its fishd]")
@set_option
@click.option(
    "--settings",
    "settings_file",
    type=click.Path(path_type=Path),
    help="YAML file of the training, such as config/learning.yaml; without it, the defaults.",
)
@click.option(
    "--see",
    type=click.Choice(["force", "camera", "both"]),
    help="Observations of the agent; settings such as config/learning-cnn.yaml say how "
    "pictures become numbers. [default: that of the settings, force]",
)
@click.option(
    "--camera",
    metavar="ADDRESS",
    help="With --see, live: request address of fishd-camera. [default: $FISHD_CAMERA, else that of "
    "this machine]",
)
@camera_config_option("With --see, in simulation: ")
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    help="Control steps to learn from, in all; rounded up to whole rollouts of ppo.n_steps. A "
    "simulated training ends earlier, with a good policy, once its evaluations stop improving; "
    "evaluation.patience: null in the settings makes it do all steps.",
)
@seed_option("the training", None)
@click.option(
    "--folder",
    type=click.Path(path_type=Path),
    help="New folder of the training. [default: ppo-DATE-TIME in $FISHD_RUNS, else runs]",
)
@click.option(
    "--resume",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Resume the training in this folder, from its newest checkpoint and with its settings; "
    "of several seeds those that are not finished, or one of them: runs/ten/seed-3.",
)
@click.option(
    "--fine-tune",
    "parent",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Begin with the best networks of another run, or with those of one of its checkpoints: "
    "to fine-tune on the robot what was trained in simulation.",
)
@endpoint_option
@take_option
@dry_run_option
@click.option(
    "--agent",
    metavar="ADDRESS",
    help="For a robot elsewhere: address at which its fishd reaches this program, such as "
    "tcp://127.0.0.1:9873 at the end of an ssh tunnel. [default: any free port of this machine]",
)
@click.option("--seeds", type=click.IntRange(min=1), help="Number of seeds to train, in parallel.")
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    help="With --seeds: number of processes. [default: one per core]",
)
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="With --seeds: let the workers of a Dask cluster train; address of its scheduler, or its "
    "file NAME.json. --resume without it trains on this machine.",
)
@plot_option("the thrust at each evaluation")
@json_option
def ppo(
    on: On | None,
    file: Path | None,
    overrides: tuple[str, ...],
    settings_file: Path | None,
    see: Literal["force", "camera", "both"] | None,
    camera: str | None,
    camera_config: str | None,
    steps: int | None,
    seed: int | None,
    folder: Path | None,
    resume: Path | None,
    parent: Path | None,
    endpoint: str | None,
    is_dry: bool,
    agent: str | None,
    seeds: int | None,
    jobs: int | None,
    cluster: str | None,
    picture: Path | None,
    as_json: bool,
) -> int:
    """Train a policy with PPO; write checkpoints, tables and TensorBoard logs to a run folder.

    After Ctrl-C the fish is at neutral, and --resume continues from the last checkpoint.
    """
    from fishd.lab import drawing
    from fishd.learning.run_folder import figure

    if picture:
        drawing.check(picture)
    run_options: dict[str, Any] = {
        "--config": file,
        "--set": overrides,
        "--settings": settings_file,
    }
    run_options |= {"--see": see, "--seed": seed}
    new_run_options = {"--folder": folder, "--fine-tune": parent}
    resumes_seeds = bool(resume and _read_command(click.get_current_context(), resume))
    if resumes_seeds:
        resume, folder = None, resume
    if resume:
        _refuse(BY_RESUME, {**run_options, **new_run_options, "--seeds": seeds})
    if seeds is None:
        _refuse("without --seeds", {"--jobs": jobs, "--cluster": cluster})
    elif on == "live":
        raise click.UsageError("--seeds is for simulated fish: there is only one live fish")
    if not resume:
        on = on or ("simulation" if seeds else default_on(file, overrides, endpoint))
    job = _prepare_job(on, file, overrides, settings_file, folder, resume, parent, endpoint)
    if job.on == "simulation":
        _refuse(
            "here: this swims in this process, and no fishd has to reach it", {"--agent": agent}
        )
        if resume:
            _refuse(BY_RESUME, {"--camera": camera, "--camera-config": camera_config})
    else:
        _refuse("here: the fish is live; give --camera", {"--camera-config": camera_config})
    given_settings = {"steps": steps, "seed": seed, "see": see}
    changed = {name: value for name, value in given_settings.items() if value is not None}
    job = replace(job, agent=agent, settings=replace(job.settings, **changed))
    job = _add_camera(job, camera_config or camera)
    if is_dry:
        job.check()
        steps = job.last_step()
        seconds = steps * job.config.tick if job.on == "live" else None
        end_dry_run(Plan(steps * (seeds or 1), "steps", seconds), as_json)
    if seeds is not None:
        job = replace(job, resume=resumes_seeds)
        status, draw = _train_seeds(job, seeds, jobs, cluster, as_json), figure.draw_seeds
    else:
        status, draw = _train(job, as_json), figure.draw
    if picture:
        draw(picture, job.folder)
    return status


def _refuse(why: str, options: dict[str, Any]) -> None:
    given = [name for name, value in options.items() if value not in (None, ())]
    if given:
        raise click.UsageError(f"{given[0]} cannot be given {why}")


def _prepare_job(
    on: On | None,
    file: Path | None,
    overrides: tuple[str, ...],
    settings_file: Path | None,
    folder: Path | None,
    resume: Path | None,
    parent: Path | None,
    endpoint: str | None,
) -> "Job":
    """Return the run to resume, or a new run, by default with the settings of its parent.

    Raises `ConfigError` and `CheckpointError`.
    """
    from fishd.lab.experiment import default_folder
    from fishd.learning import settings as training
    from fishd.learning.links.fishd_link import config_of, plant_differences
    from fishd.learning.run_folder import checkpoints, runs
    from fishd.learning.train.jobs import Job

    if resume:
        checkpoints.refuse_several(resume)
        config, settings = runs.read(resume)
        on = on or checkpoints.read_state(checkpoints.newest(resume)).on
    running_config = config_of(endpoint) if on == "live" else {}
    plant = dict(running_config.get("plant", {}))  # `adopt` changes it
    if not resume:
        parent_settings = runs.read(_find_run_folder(parent))[1] if parent else None
        settings = (
            parent_settings
            if parent_settings and not settings_file
            else training.load(settings_file)
        )
        is_adopted = running_config and not file
        config = adopt(running_config, overrides) if is_adopted else load(file, overrides)
    # The plant scales the inputs, and that of fishd is most likely right.
    if running_config and (difference := plant_differences(config, plant)):
        echo(
            "fishctl: careful: scales and relative thrust are those of another plant than "
            f"that of the fishd that runs: {difference}",
            err=True,
        )
    return Job(
        command=kept_arguments(click.get_current_context()),
        config=config,
        settings=settings,
        folder=resume or folder or default_folder("learn ppo"),
        on=on or "simulation",
        endpoint=endpoint,
        take=verb_lease().take,
        resume=resume is not None,
        parent=checkpoints.find(parent) if parent else None,
    )


def _add_camera(job: "Job", camera: str | None) -> "Job":
    """Return the job with its camera, if any; raise `ConfigError` and `ParameterError`.

    camera: file of a simulated camera; address of the camera of a live fish
    """
    from fishd.camera import settings as cameras
    from fishd.learning.run_folder import runs
    from fishd.learning.settings import check

    check(job.settings)
    if job.settings.see == "force":
        _refuse("here: this sees forces only; give --see camera, too", {"--camera": camera})
        return job
    if job.on == "live":
        return replace(job, camera_endpoint=camera)
    if job.resume:
        return replace(job, camera=runs.read_camera(job.folder))
    return replace(job, camera=cameras.load_simulated(camera))


def _train(job: "Job", as_json: bool) -> int:
    from fishd.learning.train.progress import ShownDisplay, list_estimates
    from fishd.learning.train.training import train

    stopping = threading.Event()
    with on_signal(stopping.set), show_progress(job.last_step(), "steps", err=as_json) as progress:
        outcome = train(job, ShownDisplay(progress), stopping.is_set)
    if best := outcome.best_evaluation:
        headline = f"To write it to a file: fishctl learn export {outcome.folder.name}"
        report_progress(Progress(1.0, 0.0, headline, list_estimates(best)))
    if as_json:
        print_json(outcome)
    return print_outcome(outcome, job, as_json)


def print_outcome(outcome: "Outcome", job: "Job", as_json: bool = False) -> int:
    """Print how a training ended; return the exit status."""
    from fishd.learning.train.progress import NOT_COUNTED, format_evaluation, format_minutes

    resume_command = f"fishctl learn ppo --resume {outcome.folder}"
    for option, address in (
        ("--endpoint", job.endpoint),
        ("--agent", job.agent),
        ("--camera", job.camera_endpoint),
    ):
        if address:
            resume_command += f" {option} {address}"
    if outcome.ended == "diverged":  # a resumed run would diverge, too
        best = (
            f"; to export the best policy: fishctl learn export {outcome.folder}"
            if outcome.best
            else ""
        )
        echo(f"fishctl: {outcome.message}{best}", err=True)
        return 1
    if outcome.ended == "lost":
        echo(f"fishctl: {outcome.message}; resume with: {resume_command}", err=True)
        return 1
    if outcome.ended == "interrupted":
        lost = f", {outcome.dropped} of an unfinished rollout dropped" if outcome.dropped else ""
        echo(
            f"fishctl: stopped after {outcome.steps} steps{lost}; resume with: {resume_command}",
            err=True,
        )
        return INTERRUPTED
    remark = NOT_COUNTED if job.on == "simulation" else ""
    reason = f"; {outcome.message}" if outcome.message else ""
    echo(
        f"{outcome.steps} steps in {format_minutes(outcome.tank_time)} of tank time"
        f"{remark}{reason}",
        err=as_json,
    )
    if evaluation := outcome.best_evaluation:
        echo(f"best: {format_evaluation(evaluation).strip()}", err=as_json)
        relative_error = (
            evaluation.thrust_ci95 / evaluation.thrust if evaluation.thrust_ci95 else 0.0
        )
        if evaluation.relative_thrust * (1.0 - relative_error) > MAX_RELATIVE_THRUST:
            echo(
                "careful: that is more than the best square wave of the configured plant; the fish "
                "is another one, or F_x is not calibrated, or it drifts",
                err=as_json,
            )
    elif outcome.latest_evaluation:
        stalled = "it stalled in every evaluation; train it for longer, or with another --seed"
        echo(stalled, err=as_json)
        return 0
    echo(f"to write it to a policy file: fishctl learn export {outcome.folder}", err=as_json)
    return 0


def _find_run_folder(path: Path) -> Path:
    """Return the folder of a run or of one of its checkpoints; raise `ConfigError`."""
    from fishd.learning.run_folder.runs import SETTINGS

    if not path.is_dir():
        problem = "a policy file has no value network" if path.exists() else "no such folder"
        raise ConfigError(
            f"--fine-tune {path}: {problem}; give a run folder or one of its checkpoints"
        )
    return path if (path / SETTINGS).exists() else path.parent


def _train_seeds(
    job: "Job", seeds: int, jobs: int | None, cluster: str | None, as_json: bool
) -> int:
    """Train all seeds, print a line as each ends, and a summary; return the exit status."""
    from fishd.lab.experiment import Header, open_experiment
    from fishd.learning.train import seeds as training

    if not cluster and find_spec("torch") is None:  # only the training processes load it
        raise ModuleNotFoundError("torch is missing", name="torch")
    header = Header(
        kind=_KIND,
        on=job.on,
        config=to_builtins(job.config),
        settings={"training": to_builtins(job.settings), "camera": to_builtins(job.camera)},
        command=list(kept_arguments(click.get_current_context())),
    )
    ended = partial(_print_seed, err=as_json)
    outcomes: list[Outcome] = []
    with open_experiment(job.folder, header, resume=job.resume) as experiment:
        echo(f"{job.folder}: {seeds} seeds of {job.last_step()} steps", err=as_json)
        ending = Ending(experiment, cluster)
        with ending.measuring():
            outcomes = training.train_seeds(replace(job, resume=False), seeds, jobs, cluster, ended)
            if any(outcome.ended == "interrupted" for outcome in outcomes):
                raise Interrupted
        _print_seeds(job, outcomes, as_json)
        finished = sum(outcome.ended == "finished" for outcome in outcomes)
        ending.check(f"{finished} of {seeds} seeds are finished")
    return 0 if finished == len(outcomes) else 1


def _print_seeds(job: "Job", outcomes: "list[Outcome]", as_json: bool) -> None:
    if as_json:
        print_json(outcomes)
    for name, evaluations in (
        ("latest", [outcome.latest_evaluation for outcome in outcomes]),
        ("best", [outcome.best_evaluation for outcome in outcomes]),
    ):
        shares = [evaluation.relative_thrust for evaluation in evaluations if evaluation]
        if shares:
            echo(
                f"{name} policies of {len(shares)} seeds: median {statistics.median(shares):.1%} "
                f"[{min(shares):.1%} – {max(shares):.1%}]",
                err=as_json,
            )
    echo(f"curves: {job.folder / 'seeds.csv'}", err=as_json)


def _print_seed(seed: int, outcome: "Outcome", err: bool) -> None:
    from fishd.learning.train.progress import format_evaluation

    latest = outcome.latest_evaluation
    result = f": {format_evaluation(latest).strip()}" if latest else ""
    is_finished = outcome.ended == "finished"
    ended = "" if is_finished else f" {outcome.ended}"
    reason = f" ({outcome.message})" if outcome.message else ""
    echo(f"seed {seed}{ended}{reason}{result}", err=err or not is_finished)
