"""The same training with several seeds at once: on the cores of this machine, or on a Dask cluster.

Each has the folder seed-0, seed-1, ... of the run folder. A seed that fails is reported and costs
the others nothing; one whose process was killed goes on from its newest checkpoint in another.
"""

import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError
from msgspec import Struct
from msgspec.structs import replace

from fishd.errors import FishdError
from fishd.learning.checkpoints import Evaluation
from fishd.learning.cluster import asked, packed, scheduler, unpack
from fishd.learning.jobs import Job
from fishd.learning.runs import make_folder
from fishd.learning.seed_table import write_summary
from fishd.learning.stopping import on_signal
from fishd.learning.training import train

STOP = "stop"
"""A file of this name in the run folder ends the trainings in it."""

_ATTEMPTS = 3


class SeedOutcome(Struct, frozen=True):
    """How the training of one seed ended."""

    seed: int
    ended: str
    """finished, interrupted, lost or diverged, as in `Outcome`; or failed."""
    message: str
    """Why, where it is not finished."""
    steps: int
    latest: Evaluation | None
    best: Evaluation | None


class _Task(NamedTuple):
    """What travels to a worker."""

    number: int
    job: Job
    stop: str
    """Path of the file, or name of the Dask event, that says stop."""


def train_seeds(
    job: Job,
    seeds: int,
    jobs: int | None = None,
    cluster: str | None = None,
    ended: Callable[[SeedOutcome], None] = lambda outcome: None,
) -> list[SeedOutcome]:
    """Train `seeds` times; the seeds count up from that of the job, so does that of its noise.

    jobs: processes at a time; None is one per core
    cluster: address of a Dask scheduler, whose workers train instead; they need fishd and its
        extra `learn`, but no folder in common with this machine
    ended: called with each outcome as it comes

    SIGINT, SIGTERM and SIGHUP end all of them, each with a checkpoint. Raises `ConfigError` where
    the folder is in use, and `FishdError` where there is no scheduler.
    """
    folder = job.folder.absolute()
    waiting = {index: _job_of(job, folder, index) for index in range(seeds)}
    outcomes: dict[int, SeedOutcome] = {}

    def keep(index: int, outcome: SeedOutcome) -> None:
        outcomes[index] = outcome
        ended(outcome)

    with scheduler(cluster) as event, _ask_to_stop(folder / STOP, event):
        make_folder(folder)
        name = event.name if event else str(folder / STOP)
        for attempt in range(_ATTEMPTS):
            tasks = [
                _Task(index, job, name) for index, job in waiting.items() if index not in outcomes
            ]
            try:
                for index, outcome, files in _run(tasks, jobs, cluster):
                    if files:
                        unpack(files, waiting[index].folder)
                    keep(index, outcome)
            except TerminatedWorkerError:
                if attempt + 1 < _ATTEMPTS:
                    continue  # whose it was, nobody knows: all that are left go on
                for task in tasks:
                    if task.number not in outcomes:
                        keep(task.number, _failed(task.job, "its process was killed"))
            break
    write_summary(folder / "seeds.csv", [waiting[index].folder for index in range(seeds)])
    return [outcomes[index] for index in range(seeds)]


def _job_of(job: Job, folder: Path, index: int) -> Job:
    rig = job.config.simulation
    return replace(
        job,
        config=replace(job.config, simulation=replace(rig, seed=rig.seed + index)),
        settings=replace(job.settings, seed=job.settings.seed + index),
        folder=folder / f"seed-{index}",
        parent=job.parent.absolute() if job.parent else None,
    )


def _run(
    tasks: list[_Task], jobs: int | None, cluster: str | None
) -> Iterator[tuple[int, SeedOutcome, bytes]]:
    """Outcomes as they come, where the backend can do that; else in the end."""
    if cluster:
        with joblib.parallel_config(backend="dask", scheduler_host=cluster):
            try:
                found = joblib.Parallel()(joblib.delayed(_train_remotely)(task) for task in tasks)
            except Exception as error:  # joblib, Dask and their connections have many of their own
                raise FishdError(
                    f"the Dask cluster at {cluster} was lost, and with it the trainings that it "
                    f"had not sent back: {type(error).__name__}: {error}"
                ) from error
        yield from found
        return
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        workers = min(jobs or joblib.cpu_count(), len(tasks))
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1, return_as="generator_unordered")
        with _spared_by_the_terminal():
            outcomes = parallel(joblib.delayed(_train_here)(task) for task in tasks)
        yield from outcomes


@contextmanager
def _spared_by_the_terminal() -> Iterator[None]:
    """Processes that begin in here never hear Ctrl-C or the terminal's end: this one says stop."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # What is ignored stays so in a child, unlike what is handled.
    former = {
        number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _train_here(task: _Task) -> tuple[int, SeedOutcome, bytes]:
    """In a process of its own on this machine."""
    stop = Path(task.stop)
    return task.number, _train(task.job, stop.exists), b""


def _train_remotely(task: _Task) -> tuple[int, SeedOutcome, bytes]:
    """On a Dask worker, in a temporary folder whose files are sent back."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / task.job.folder.name
        outcome = _train(replace(task.job, folder=folder), asked(task.stop))
        return task.number, outcome, packed(folder)


def _train(job: Job, stop: Callable[[], bool]) -> SeedOutcome:
    """Train, or go on where a process before this one was killed; whatever is raised is kept."""
    seed = job.settings.seed
    if stop():
        return SeedOutcome(seed, "interrupted", "it had not begun", 0, None, None)
    try:
        if job.folder.exists():
            if any(job.folder.glob("step-*")):
                job = replace(job, resume=True, parent=None)
            else:
                shutil.rmtree(job.folder)
        found = train(job, stop=stop)
    except Exception as error:
        text = str(error) if isinstance(error, FishdError) else f"{type(error).__name__}: {error}"
        return _failed(job, text)
    latest, best = found.latest_evaluation, found.best_evaluation
    return SeedOutcome(seed, found.ended, found.message, found.steps, latest, best)


def _failed(job: Job, message: str) -> SeedOutcome:
    return SeedOutcome(job.settings.seed, "failed", message, 0, None, None)


@contextmanager
def _ask_to_stop(file: Path, event: Any) -> Iterator[None]:
    """While this lasts, signals say stop to all of them."""

    def ask() -> None:
        if event:
            threading.Thread(target=event.set).start()  # it waits for the scheduler
        else:
            file.touch()

    try:
        with on_signal(ask):
            yield
    finally:
        file.unlink(missing_ok=True)
