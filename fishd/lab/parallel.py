"""Parallel computations on the cores of this machine, or on the workers of a Dask cluster."""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from uuid import uuid4

import joblib
from joblib._multiprocessing_helpers import mp as multiprocessing
from joblib.externals.loky.process_executor import TerminatedWorkerError

from fishd.core.errors import FishdError
from fishd.core.process.safe_path import SafeChildren

T = TypeVar("T")
R = TypeVar("R")

CONNECT_TIMEOUT_S = 10.0
"""Timeout of the connection to a scheduler [s]."""
_POLL_INTERVAL_S = 1.0
"""Interval at which a worker asks the scheduler whether to stop [s]."""
_MAX_ATTEMPTS = 3
"""Largest number of starts of a task, if processes are killed."""


class Killed(FishdError):
    """Processes were killed repeatedly; `unfinished` are the indices of the unfinished tasks."""

    def __init__(self, unfinished: Sequence[int]) -> None:
        super().__init__("the worker processes were killed, most likely because memory ran out")
        self.unfinished = unfinished


class Stop(NamedTuple):
    """A signal to stop, which is passed to tasks in all processes and on all machines."""

    name: str
    """Path of the file, or name of the Dask event, whose existence means stop."""
    is_remote: bool

    def make_check(self) -> Callable[[], bool]:
        """Return a function, for use in a task, that returns whether to stop."""
        return _make_event_check(self.name) if self.is_remote else Path(self.name).exists


class Workers:
    """The processes that compute: on this machine, or the workers of a cluster."""

    def __init__(self, stop: Stop, jobs: int | None, cluster: str | None, event: Any) -> None:
        """event: event of the cluster that means stop"""
        self.stop = stop
        self._jobs = jobs
        self._cluster = cluster
        self._event = event

    def ask_to_stop(self) -> None:
        """Tell all tasks to stop, also those that have not started; returns immediately."""
        if self._event:
            threading.Thread(target=self._event.set).start()  # it waits for the scheduler
        else:
            Path(self.stop.name).touch()

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield index and result of each task, in the order in which they end.

        function: function at the top level of a module; its argument and result are pickled

        On this machine, tasks are restarted after a process was killed. Raises `Killed`, and
        `FishdError` where the cluster is lost.
        """
        unfinished = dict(enumerate(tasks))
        for _ in range(_MAX_ATTEMPTS):
            try:
                for index, result in self._run_attempt(function, unfinished):
                    del unfinished[index]
                    yield index, result
            except TerminatedWorkerError:
                continue  # which process was killed is unknown: all unfinished tasks start again
            return
        raise Killed(list(unfinished))

    def _run_attempt(
        self, function: Callable[[T], R], tasks: dict[int, T]
    ) -> Iterator[tuple[int, R]]:
        calls = [
            joblib.delayed(_run_numbered)(function, index, task) for index, task in tasks.items()
        ]
        if self._cluster:
            with joblib.parallel_config(backend="dask", client=self._event.client):
                try:
                    yield from joblib.Parallel(return_as="generator_unordered")(calls)
                except FishdError:
                    raise
                except Exception as error:  # joblib and Dask raise many kinds
                    raise FishdError(
                        f"the Dask cluster at {self._cluster} was lost, with its unfinished tasks: "
                        f"{type(error).__name__}: {error}"
                    ) from error
            return
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
def workers(stop: Path, jobs: int | None = None, cluster: str | None = None) -> Iterator[Workers]:
    """Provide workers while this lasts.

    stop: path of the file that means stop, on this machine; it is removed at the start, in case
        a killed process left it, and at the end
    jobs: number of processes; None for one per core
    cluster: address of a Dask scheduler whose workers compute instead

    Raises `FishdError` where no scheduler answers.
    """
    if cluster is None and multiprocessing is None:
        raise FishdError(
            "parallel processes need semaphores, which cannot be created: /dev/shm is "
            "missing or not writable; mount it: sudo mount -t tmpfs shm /dev/shm"
        )
    with _connect(cluster) as event, SafeChildren():
        signal_to_stop = Stop(event.name, True) if event else Stop(str(stop), False)
        stop.unlink(missing_ok=True)
        try:
            yield Workers(signal_to_stop, jobs, cluster, event)
        finally:
            stop.unlink(missing_ok=True)


def _run_numbered(function: Callable[[T], R], index: int, task: T) -> tuple[int, R]:
    return index, function(task)


@contextmanager
def _connect(address: str | None) -> Iterator[Any]:
    """Connect to the scheduler and yield an event that means stop; None without address."""
    if address is None:
        yield None
        return
    from distributed import Client, Event

    try:
        client = Client(address, timeout=CONNECT_TIMEOUT_S, name="fishctl")
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FishdError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise FishdError(f"the Dask scheduler at {address} has no workers")
        yield Event(f"fishd-stop-{uuid4().hex}", client=client)


def _make_event_check(name: str) -> Callable[[], bool]:
    """Return a function, for use on a Dask worker, that returns whether an event was set."""
    from distributed import Event, get_client

    event = Event(name, client=get_client())
    was_set, next_look = False, 0.0

    def stop() -> bool:
        nonlocal was_set, next_look
        if not was_set and time.monotonic() >= next_look:
            was_set = event.is_set()
            next_look = time.monotonic() + _POLL_INTERVAL_S
        return was_set

    return stop
