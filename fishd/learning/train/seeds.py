"""Training with several seeds at once: on the cores of this machine, or on a Dask cluster.

Each seed trains in a folder seed-0, seed-1, ... of the run folder; one that exists is resumed. A
seed that fails is reported and does not affect the others; one whose process was killed is resumed
in another.
"""

import io
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from fishd.core.errors import FishdError
from fishd.core.process.interruption import on_signal
from fishd.lab.parallel import workers
from fishd.lab.workers import Stop
from fishd.learning.train.jobs import Job, Outcome

# Modules that import torch are imported where they are used: a process that is stopped before it
# has begun ends without torch, seconds sooner.

STOP = "stop"
"""Name of the file in the run folder that ends the trainings in it."""
STOP_TIMEOUT_S = 20.0
"""Time after a signal in which the workers of a cluster send back their checkpoints [s]."""


class _Task(NamedTuple):
    """A task that is sent to a worker."""

    job: Job
    stop: Stop
    files: bytes = b""
    """For a cluster: the run folder to resume, packed."""
    parent: bytes = b""
    """For a cluster: the checkpoint to begin with, packed."""


def train_seeds(
    job: Job,
    seeds: int,
    jobs: int | None = None,
    cluster: str | None = None,
    ended: Callable[[int, Outcome], None] = lambda seed, outcome: None,
) -> list[Outcome]:
    """Train with several seeds; both the seed of the job and that of its noise count up.

    jobs: number of processes at a time; None is one per core
    cluster: address of a Dask scheduler, whose workers train instead; they need fishd and its
        extra `learn`, but no folder in common with this machine
    ended: called with each seed and its outcome as soon as the outcome is known

    SIGINT, SIGTERM and SIGHUP end all of them, each with a checkpoint. Raises `FishdError` where
    the workers are lost; the folders of finished seeds are kept.
    """
    from fishd.learning.run_folder.tables import SEEDS, write_summary

    folder = job.folder.absolute()
    waiting = [_make_job(job, folder, index) for index in range(seeds)]
    outcomes: dict[int, Outcome] = {}

    def add_outcome(index: int, outcome: Outcome) -> None:
        outcomes[index] = outcome
        ended(waiting[index].settings.seed, outcome)

    try:
        with (
            workers(folder / STOP, jobs, cluster, STOP_TIMEOUT_S) as crew,
            on_signal(crew.ask_to_stop),
        ):
            tasks = [_Task(seed_job, crew.stop) for seed_job in waiting]
            if cluster:
                parent = pack(job.parent) if job.parent else b""
                tasks = [
                    task._replace(files=pack(task.job.folder), parent=parent) for task in tasks
                ]
            for index, result in crew.run(_train_remotely if cluster else _train_here, tasks):
                if result[1]:
                    unpack(result[1], waiting[index].folder)
                add_outcome(index, result[0])
        for index in sorted({*range(seeds)} - {*outcomes}):
            missing = Outcome(
                folder=waiting[index].folder,
                ended="interrupted",
                message="its worker has not answered",
            )
            add_outcome(index, missing)
    finally:
        write_summary(folder / SEEDS, [job.folder for job in waiting])
    return [outcomes[index] for index in range(seeds)]


def _make_job(job: Job, folder: Path, index: int) -> Job:
    rig = job.config.simulation
    return replace(
        job,
        config=replace(job.config, simulation=replace(rig, seed=rig.seed + index)),
        settings=replace(job.settings, seed=job.settings.seed + index),
        folder=folder / f"seed-{index}",
        parent=job.parent.absolute() if job.parent else None,
    )


def _train_here(task: _Task) -> tuple[Outcome, bytes]:
    """Train in a worker process on this machine."""
    return _train(task.job, task.stop.make_check()), b""


def _train_remotely(task: _Task) -> tuple[Outcome, bytes]:
    """Train on a Dask worker, in a temporary folder whose files are sent back."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, parent = Path(temporary) / task.job.folder.name, task.job.parent
        if task.files:
            unpack(task.files, folder)
        if parent:
            parent = Path(temporary, "parent", *parent.parts[-2:])
            unpack(task.parent, parent)
        job = replace(task.job, folder=folder, parent=parent)
        outcome = _train(job, task.stop.make_check())
        home = task.job.folder
        outcome = replace(
            outcome,
            folder=home,
            checkpoint=outcome.checkpoint and home / outcome.checkpoint.name,
            best=outcome.best and home / outcome.best.name,
        )
        return outcome, pack(folder)


def _train(job: Job, stop: Callable[[], bool]) -> Outcome:
    """Train, or resume the training of a killed process; an exception becomes an outcome."""
    if stop():
        return Outcome(folder=job.folder, ended="interrupted", message="it had not begun")
    from fishd.learning.run_folder import checkpoints
    from fishd.learning.train.training import train

    try:
        if checkpoints.list_all(job.folder):
            finished = _read_finished(job)
            if finished:
                return finished
            job = replace(job, resume=True, parent=None)
        elif job.folder.exists():
            shutil.rmtree(job.folder)
        return train(job, stop=stop)
    except Exception as error:
        text = str(error) if isinstance(error, FishdError) else f"{type(error).__name__}: {error}"
        return _make_failure(job, text)


def _read_finished(job: Job) -> Outcome | None:
    """Return the outcome of a finished seed whose process was killed; None if not finished."""
    from fishd.learning.run_folder import checkpoints

    checkpoints.remove_partial(job.folder)
    newest = checkpoints.newest(job.folder)
    state = checkpoints.read_state(newest)
    if not state.is_finished(job.settings.steps):
        return None
    return Outcome(
        folder=job.folder,
        steps=state.steps,
        tank_time=state.tank_time,
        ended="finished",
        checkpoint=newest,
        best=checkpoints.best(job.folder),
        latest_evaluation=state.latest,
        best_evaluation=state.best,
    )


def _make_failure(job: Job, message: str) -> Outcome:
    return Outcome(folder=job.folder, ended="failed", message=message)


def pack(folder: Path) -> bytes:
    """Return all files of a folder as one zip archive, or no bytes if there are none."""
    paths = sorted(folder.rglob("*"))
    if not paths:
        return b""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            archive.write(path, path.relative_to(folder))
    return buffer.getvalue()


def unpack(files: bytes, folder: Path) -> None:
    """Write the files of an archive made by `pack` into a folder."""
    with zipfile.ZipFile(io.BytesIO(files)) as archive:
        archive.extractall(folder)
