"""The same training with several seeds at once: on the cores of this machine, or on a Dask cluster.

Each seed trains in a folder seed-0, seed-1, ... of the run folder. A seed that fails is reported
and does not affect the others; one whose process was killed is resumed in another.
"""

import io
import shutil
import signal
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError
from msgspec.structs import replace

from fishd.core.errors import FishdError
from fishd.learning.train.jobs import Job, Outcome

# What brings torch is imported where it is used: a process that is told to stop before it has
# begun ends without it, seconds sooner.

STOP = "stop"
"""A file of this name in the run folder ends the trainings in it."""
CONNECT = 10.0
"""How long to wait for a scheduler that does not answer [s]."""
_POLL = 1.0
"""How often a worker asks the scheduler whether to stop [s]."""
_ATTEMPTS = 3
"""How often what is left is begun, where a process was killed."""


class _Task(NamedTuple):
    """What is sent to a worker."""

    number: int
    job: Job
    stop: str
    """Path of the file, or name of the Dask event, that tells it to stop."""


def train_seeds(
    job: Job,
    seeds: int,
    jobs: int | None = None,
    cluster: str | None = None,
    ended: Callable[[int, Outcome], None] = lambda seed, outcome: None,
) -> list[Outcome]:
    """Train with several seeds, which count up from that of the job, as that of its noise does.

    jobs: processes at a time; None is one per core
    cluster: address of a Dask scheduler, whose workers train instead; they need fishd and its
        extra `learn`, but no folder in common with this machine
    ended: called with each seed and its outcome as soon as it is known

    SIGINT, SIGTERM and SIGHUP end all of them, each with a checkpoint. Raises `ConfigError` where
    the folder is in use, and `FishdError` where there is no scheduler.
    """
    from fishd.learning.run_folder.runs import make_folder
    from fishd.learning.run_folder.tables import write_summary

    folder = job.folder.absolute()
    waiting = [_job_of(job, folder, index) for index in range(seeds)]
    outcomes: dict[int, Outcome] = {}

    def keep(index: int, outcome: Outcome) -> None:
        outcomes[index] = outcome
        ended(waiting[index].settings.seed, outcome)

    with scheduler(cluster) as event, _stop_on_signal(folder / STOP, event):
        make_folder(folder)
        name = event.name if event else str(folder / STOP)
        for attempt in range(_ATTEMPTS):
            tasks = [_Task(n, job, name) for n, job in enumerate(waiting) if n not in outcomes]
            try:
                for index, outcome, files in _run(tasks, jobs, cluster):
                    if files:
                        unpack(files, waiting[index].folder)
                    keep(index, outcome)
            except TerminatedWorkerError:
                if attempt + 1 < _ATTEMPTS:
                    continue  # which process was killed is not known: all that are left are resumed
                for task in tasks:
                    if task.number not in outcomes:
                        keep(task.number, _failed(task.job, "its process was killed"))
            break
    write_summary(folder / "seeds.csv", [job.folder for job in waiting])
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
) -> Iterator[tuple[int, Outcome, bytes]]:
    """Index, outcome and packed folder of each task: as they end, on a cluster all at the end."""
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
        from fishd.learning.train.training import handled

        # Its processes ignore Ctrl-C and hang-up, which a child inherits: they are told to stop.
        with handled((signal.SIGINT, signal.SIGHUP), signal.SIG_IGN):
            outcomes = parallel(joblib.delayed(_train_here)(task) for task in tasks)
        yield from outcomes


def _train_here(task: _Task) -> tuple[int, Outcome, bytes]:
    """In a process of its own on this machine."""
    return task.number, _train(task.job, Path(task.stop).exists), b""


def _train_remotely(task: _Task) -> tuple[int, Outcome, bytes]:
    """On a Dask worker, in a temporary folder whose files are sent back."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / task.job.folder.name
        outcome = _train(replace(task.job, folder=folder), stop_requested(task.stop))
        home = task.job.folder
        outcome = replace(
            outcome,
            folder=home,
            checkpoint=outcome.checkpoint and home / outcome.checkpoint.name,
            best=outcome.best and home / outcome.best.name,
        )
        return task.number, outcome, pack(folder)


def _train(job: Job, stop: Callable[[], bool]) -> Outcome:
    """Train, or resume what a killed process has begun; an exception is an outcome, too."""
    if stop():
        return Outcome(folder=job.folder, ended="interrupted", message="it had not begun")
    from fishd.learning.run_folder import checkpoints
    from fishd.learning.train.training import train

    try:
        if checkpoints.all_in(job.folder):
            job = replace(job, resume=True, parent=None)
        elif job.folder.exists():
            shutil.rmtree(job.folder)
        return train(job, stop=stop)
    except Exception as error:
        text = str(error) if isinstance(error, FishdError) else f"{type(error).__name__}: {error}"
        return _failed(job, text)


def _failed(job: Job, message: str) -> Outcome:
    return Outcome(folder=job.folder, ended="failed", message=message)


@contextmanager
def _stop_on_signal(file: Path, event: Any) -> Iterator[None]:
    """While this lasts, signals tell all of them to stop."""
    from fishd.learning.train.training import on_signal

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


@contextmanager
def scheduler(address: str | None) -> Iterator[Any]:
    """A connection to the scheduler, and an event there that means stop; None without address."""
    if address is None:
        yield None
        return
    from distributed import Client, Event

    try:
        client = Client(address, timeout=CONNECT, name="fishctl learn")
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FishdError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise FishdError(f"the Dask scheduler at {address} has no workers")
        yield Event(f"fishd-stop-{uuid4().hex}", client=client)


def stop_requested(name: str) -> Callable[[], bool]:
    """A function, for use on a Dask worker, that tells whether an event of this name was set."""
    from distributed import Event, get_client

    event = Event(name, client=get_client())
    was_set, next_look = False, 0.0

    def stop() -> bool:
        nonlocal was_set, next_look
        if not was_set and time.monotonic() >= next_look:
            was_set = event.is_set()
            next_look = time.monotonic() + _POLL
        return was_set

    return stop


def pack(folder: Path) -> bytes:
    """All files of a folder as one zip archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            archive.write(path, path.relative_to(folder))
    return buffer.getvalue()


def unpack(files: bytes, folder: Path) -> None:
    """Write the files of such an archive into a folder."""
    with zipfile.ZipFile(io.BytesIO(files)) as archive:
        archive.extractall(folder)
