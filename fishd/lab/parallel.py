"""Parallel computations on the cores of this machine, or on the workers of a Dask cluster."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import NamedTuple, TypeVar

import joblib
from joblib._multiprocessing_helpers import mp as multiprocessing
from joblib.externals.loky.process_executor import TerminatedWorkerError

from fishd.core.errors import FishdError
from fishd.core.process.safe_path import SafeChildren
from fishd.lab.workers import Unfinished, Workers

T = TypeVar("T")
R = TypeVar("R")

_MAX_ATTEMPTS = 3
"""Largest number of starts of a task, if processes are killed."""


class FileStop(NamedTuple):
    """A file whose existence means stop."""

    path: Path

    def make_check(self) -> Callable[[], bool]:
        """Return a function, for use in a task, that returns whether to stop."""
        return self.path.exists


class _Processes:
    """Processes on this machine."""

    def __init__(self, stop: Path, jobs: int | None) -> None:
        self.stop = FileStop(stop)
        self._jobs = jobs

    def ask_to_stop(self) -> None:
        self.stop.path.touch()

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        unfinished = dict(enumerate(tasks))
        for _ in range(_MAX_ATTEMPTS):
            try:
                for index, result in self._run_attempt(function, unfinished):
                    del unfinished[index]
                    yield index, result
            except TerminatedWorkerError:
                continue  # which process was killed is unknown: all unfinished tasks start again
            return
        message = "the worker processes were killed, most likely because memory ran out"
        raise Unfinished(message, list(unfinished))

    def _run_attempt(
        self, function: Callable[[T], R], tasks: dict[int, T]
    ) -> Iterator[tuple[int, R]]:
        calls = [
            joblib.delayed(_run_numbered)(function, index, task) for index, task in tasks.items()
        ]
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            count = max(1, min(self._jobs or joblib.cpu_count(), len(tasks)))
            parallel = joblib.Parallel(n_jobs=count, batch_size=1, return_as="generator_unordered")
            # Worker processes inherit the blocked SIGINT and SIGHUP: they stop by `stop`. A signal
            # that arrives meanwhile is handled here a little later. The resource tracker, which
            # starts with the first worker, would unblock SIGINT (in Python 3.11), so it starts now.
            resource_tracker.ensure_running()
            old_mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
            try:
                results = parallel(calls)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, old_mask)
            yield from results


@contextmanager
def workers(
    stop: Path, jobs: int | None = None, cluster: str | None = None, stop_timeout: float = 0.5
) -> Iterator[Workers]:
    """Provide workers while this lasts.

    stop: path of the file that means stop, on this machine; it is removed at the start, in case
        a killed process left it, and at the end
    jobs: number of processes; None for one per core
    cluster: address of a Dask scheduler whose workers compute instead, or the path of its file
    stop_timeout: time after a request to stop in which results of a cluster are received [s]

    Raises `FishdError` where they cannot be used.
    """
    if cluster:
        from fishd.lab.cluster import connect

        with connect(cluster, stop_timeout) as connected:
            yield connected
        return
    if multiprocessing is None:
        raise FishdError(
            "parallel processes need semaphores, which cannot be created: /dev/shm is "
            "missing or not writable; mount it: sudo mount -t tmpfs shm /dev/shm"
        )
    with SafeChildren():
        stop.unlink(missing_ok=True)
        try:
            yield _Processes(stop, jobs)
        finally:
            stop.unlink(missing_ok=True)


def _run_numbered(function: Callable[[T], R], index: int, task: T) -> tuple[int, R]:
    return index, function(task)
