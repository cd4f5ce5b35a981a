"""The verb that trains."""

import statistics
import threading
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
from msgspec.structs import replace

from fishd.cli.config import config_option, set_option
from fishd.cli.experiment_options import On, default_on, on_option
from fishd.cli.options import endpoint_option, json_option, seed_option, take_option, verb_lease
from fishd.cli.output import echo, print_json
from fishd.cli.progress import showing
from fishd.config import adopt, load
from fishd.core.console import INTERRUPTED
from fishd.core.errors import ConfigError
from fishd.core.process.interruption import on_signal

if TYPE_CHECKING:
    from fishd.learning.train.jobs import Job, Outcome

IMPLAUSIBLE = 1.03
"""Largest relative thrust that can be true; above it the measurement is wrong."""
AS_IT_BEGAN = "with --resume, which goes on as the run began"


@click.command()
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
    help="What the agent sees of the fish; settings such as config/learning-cnn.yaml say how "
    "pictures become numbers. [default: that of the settings, force]",
)
@click.option(
    "--camera",
    metavar="FILE|ENDPOINT",
    help="With --see: in simulation, the YAML file of a simulated camera, such as "
    "config/camera-web.yaml; live, where its fishd-camera takes requests. [default: a good "
    "simulated one; $FISHD_CAMERA, else that of this machine]",
)
@click.option(
    "--steps",
    type=click.IntRange(min=1),
    help="Control steps to learn from, in all; rounded up to whole rollouts of ppo.n_steps. A "
    "simulated training ends sooner, with a good policy, once its evaluations show no better one; "
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
    help="Go on with the training in this folder, from its newest checkpoint and with its "
    "settings; of several seeds, each has a folder of its own: runs/ten/seed-3.",
)
@click.option(
    "--from",
    "parent",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Begin with the networks of another run, its best, or of one of its checkpoints: "
    "to fine-tune on the robot what was trained in simulation.",
)
@endpoint_option
@take_option
@click.option(
    "--agent",
    metavar="ADDRESS",
    help="On a robot elsewhere: where its fishd reaches this program, such as "
    "tcp://127.0.0.1:9873 at the end of an ssh tunnel. [default: any free port of this machine]",
)
@click.option("--seeds", type=click.IntRange(min=1), help="Train with so many seeds, in parallel.")
@click.option(
    "--jobs", type=click.IntRange(min=1), help="With --seeds: processes. [default: one per core]"
)
@click.option(
    "--cluster", metavar="ADDRESS", help="With --seeds: Dask scheduler that runs them instead."
)
@json_option
def ppo(
    on: On | None,
    file: Path | None,
    overrides: tuple[str, ...],
    settings_file: Path | None,
    see: Literal["force", "camera", "both"] | None,
    camera: str | None,
    steps: int | None,
    seed: int | None,
    folder: Path | None,
    resume: Path | None,
    parent: Path | None,
    endpoint: str | None,
    agent: str | None,
    seeds: int | None,
    jobs: int | None,
    cluster: str | None,
    as_json: bool,
) -> int:
    """Train a policy with PPO: checkpoints, tables and TensorBoard logs in a run folder.

    Ctrl-C leaves the fish at neutral and a checkpoint from which --resume goes on.
    """
    own: dict[str, Any] = {"--config": file, "--set": overrides, "--settings": settings_file}
    own |= {"--see": see, "--seed": seed}
    new = {"--folder": folder, "--from": parent}
    if resume:
        _refuse(AS_IT_BEGAN, {**own, **new, "--seeds": seeds})
    if seeds is None:
        _refuse("without --seeds", {"--jobs": jobs, "--cluster": cluster})
    elif on == "live":
        raise click.UsageError("--seeds is for simulated fish: there is only one live fish")
    if not resume:
        on = on or ("simulation" if seeds else default_on(file, overrides, endpoint))
    job = _job(on, file, overrides, settings_file, folder, resume, parent, endpoint)
    if job.on == "simulation":
        _refuse(
            "here: this swims in this process, and no fishd has to reach it", {"--agent": agent}
        )
        if resume:
            _refuse(AS_IT_BEGAN, {"--camera": camera})
    given = {"steps": steps, "seed": seed, "see": see}
    changed = {name: value for name, value in given.items() if value is not None}
    job = _with_camera(replace(job, agent=agent, settings=replace(job.settings, **changed)), camera)
    if seeds is not None:
        return _train_seeds(job, seeds, jobs, cluster, as_json)
    return _train(job, as_json)


def _refuse(why: str, options: dict[str, Any]) -> None:
    given = [name for name, value in options.items() if value not in (None, ())]
    if given:
        raise click.UsageError(f"{given[0]} cannot be given {why}")


def _job(
    on: On | None,
    file: Path | None,
    overrides: tuple[str, ...],
    settings_file: Path | None,
    folder: Path | None,
    resume: Path | None,
    parent: Path | None,
    endpoint: str | None,
) -> "Job":
    """The run to resume, or a new one, with the settings of its parent where none are given.

    Raises `ConfigError` and `CheckpointError`.
    """
    from fishd.lab.experiment import default_folder
    from fishd.learning import settings as training
    from fishd.learning.env.fishd_link import config_of, other_plant
    from fishd.learning.run_folder import checkpoints, runs
    from fishd.learning.train.jobs import Job

    if resume:
        checkpoints.refuse_several(resume)
        config, settings = runs.read(resume)
        on = on or checkpoints.read_state(checkpoints.newest(resume)).on
    running = config_of(endpoint) if on == "live" else {}
    plant = dict(running.get("plant", {}))  # to adopt it changes it
    if not resume:
        of_parent = runs.read(_run_of(parent))[1] if parent else None
        settings = of_parent if of_parent and not settings_file else training.load(settings_file)
        adopts = running and not file
        config = adopt(running, overrides) if adopts else load(file, overrides)
    # The inputs are scaled by the plant, and fishd's is most likely meant.
    if running and (other := other_plant(config, plant)):
        echo(
            "fishctl: careful: scales and relative thrust are made for another plant than "
            f"that of the fishd that runs: {other}",
            err=True,
        )
    return Job(
        config=config,
        settings=settings,
        folder=resume or folder or default_folder("learn ppo"),
        on=on or "simulation",
        endpoint=endpoint,
        take=verb_lease().take,
        resume=resume is not None,
        parent=checkpoints.find(parent) if parent else None,
    )


def _with_camera(job: "Job", camera: str | None) -> "Job":
    """The job with what looks at its fish; raises `ConfigError` and `ParameterError`."""
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
    return replace(job, camera=cameras.simulated(camera))


def _train(job: "Job", as_json: bool) -> int:
    from fishd.learning.train.progress import ShownDisplay
    from fishd.learning.train.training import train

    asked = threading.Event()
    with on_signal(asked.set), showing(job.last_step(), "steps", err=as_json) as show:
        outcome = train(job, ShownDisplay(show), asked.is_set)
    if as_json:
        print_json(outcome)
    return report(outcome, job, as_json)


def report(outcome: "Outcome", job: "Job", as_json: bool = False) -> int:
    """Say how it ended; the exit status."""
    from fishd.learning.train.progress import NOT_COUNTED, described, minutes

    again = f"fishctl learn ppo --resume {outcome.folder}"
    for option, address in (
        ("--endpoint", job.endpoint),
        ("--agent", job.agent),
        ("--camera", job.camera_endpoint),
    ):
        if address:
            again += f" {option} {address}"
    if outcome.ended == "diverged":  # and would again
        best = f"; the best so far: fishctl learn export {outcome.folder}" if outcome.best else ""
        echo(f"fishctl: {outcome.message}{best}", err=True)
        return 1
    if outcome.ended == "lost":
        echo(f"fishctl: {outcome.message}; resume with: {again}", err=True)
        return 1
    if outcome.ended == "interrupted":
        lost = f", {outcome.dropped} of an unfinished rollout dropped" if outcome.dropped else ""
        echo(f"fishctl: stopped after {outcome.steps} steps{lost}; resume with: {again}", err=True)
        return INTERRUPTED
    rest = NOT_COUNTED if job.on == "simulation" else ""
    why = f"; {outcome.message}" if outcome.message else ""
    echo(
        f"{outcome.steps} steps in {minutes(outcome.tank_time)} of tank time{rest}{why}",
        err=as_json,
    )
    if found := outcome.best_evaluation:
        echo(f"best: {described(found).strip()}", err=as_json)
        off = found.error / found.thrust if found.error else 0.0
        if found.relative_thrust * (1.0 - off) > IMPLAUSIBLE:
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


def _run_of(path: Path) -> Path:
    """The run folder of a run or of one of its checkpoints; raises `ConfigError`."""
    from fishd.learning.run_folder.runs import SETTINGS

    if not path.is_dir():
        what = "a policy file has no value network" if path.exists() else "no such folder"
        raise ConfigError(f"--from {path}: {what}; give a run folder or one of its checkpoints")
    return path if (path / SETTINGS).exists() else path.parent


def _train_seeds(
    job: "Job", seeds: int, jobs: int | None, cluster: str | None, as_json: bool
) -> int:
    """Train them all, a line as each ends, and a summary; the exit status."""
    from fishd.learning.train import seeds as training

    if not cluster and find_spec("torch") is None:  # only the processes that train will load it
        raise ModuleNotFoundError("torch is missing", name="torch")
    echo(f"{job.folder}: {seeds} seeds of {job.last_step()} steps", err=as_json)
    ended = partial(_print_seed, err=as_json)
    outcomes = training.train_seeds(job, seeds, jobs, cluster, ended)
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
    ends = {outcome.ended for outcome in outcomes}
    if ends - {"finished", "interrupted"}:
        return 1
    return INTERRUPTED if "interrupted" in ends else 0


def _print_seed(seed: int, outcome: "Outcome", err: bool) -> None:
    from fishd.learning.train.progress import described

    latest = outcome.latest_evaluation
    swims = f": {described(latest).strip()}" if latest else ""
    is_finished = outcome.ended == "finished"
    ended = "" if is_finished else f" {outcome.ended}"
    why = f" ({outcome.message})" if outcome.message else ""
    echo(f"seed {seed}{ended}{why}{swims}", err=err or not is_finished)
