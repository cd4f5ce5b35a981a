"""Many computations at once: on the cores of this machine, or on the workers of a Dask cluster."""

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

CONNECT = 10.0
"""How long to wait for a scheduler that does not answer [s]."""
_POLL = 1.0
"""How often a worker asks the scheduler whether to stop [s]."""
_ATTEMPTS = 3
"""How often what is left is begun, where a process was killed."""


class Killed(FishdError):
    """Processes were killed again and again; `left` are the indices of the tasks not done."""

    def __init__(self, left: Sequence[int]) -> None:
        super().__init__("the processes that compute were killed, most likely for want of memory")
        self.left = left


class Stop(NamedTuple):
    """What tells tasks to stop, wherever they run; it goes with them."""

    name: str
    """Path of the file, or name of the Dask event, that says so."""
    is_remote: bool

    def asked(self) -> Callable[[], bool]:
        """A function, for use in a task, that tells whether to stop."""
        return _event_set(self.name) if self.is_remote else Path(self.name).exists


class Workers:
    """Whoever computes: processes of this machine, or the workers of a cluster."""

    def __init__(self, stop: Stop, jobs: int | None, cluster: str | None, event: Any) -> None:
        """event: that of the cluster which means stop"""
        self.stop = stop
        self._jobs = jobs
        self._cluster = cluster
        self._event = event

    def ask_to_stop(self) -> None:
        """Tell all tasks, those that have not begun as well; returns at once."""
        if self._event:
            threading.Thread(target=self._event.set).start()  # it waits for the scheduler
        else:
            Path(self.stop.name).touch()

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Index and result of each task, in the order in which they end.

        function: at the top level of a module, as what it takes and returns crosses processes

        Tasks whose process was killed are begun again, on this machine. Raises `Killed`, and
        `FishdError` where the cluster is lost.
        """
        left = dict(enumerate(tasks))
        for _ in range(_ATTEMPTS):
            try:
                for index, result in self._once(function, left):
                    del left[index]
                    yield index, result
            except TerminatedWorkerError:
                continue  # which process was killed is not known: all that are left begin again
            return
        raise Killed(list(left))

    def _once(self, function: Callable[[T], R], tasks: dict[int, T]) -> Iterator[tuple[int, R]]:
        calls = [joblib.delayed(_numbered)(function, index, task) for index, task in tasks.items()]
        if self._cluster:
            with joblib.parallel_config(backend="dask", client=self._event.client):
                try:
                    yield from joblib.Parallel(return_as="generator_unordered")(calls)
                except FishdError:
                    raise
                except Exception as error:  # joblib, Dask and their connections have many
                    raise FishdError(
                        f"the Dask cluster at {self._cluster} was lost, and with it what it had "
                        f"not sent back: {type(error).__name__}: {error}"
                    ) from error
            return
        with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
            count = max(1, min(self._jobs or joblib.cpu_count(), len(tasks)))
            parallel = joblib.Parallel(n_jobs=count, batch_size=1, return_as="generator_unordered")
            # Its processes inherit that Ctrl-C and hang-up are blocked: they are told to stop. One
            # that comes meanwhile is heard here a little later. What else is started with the
            # first of them would unblock Ctrl-C (in Python 3.11), and so is started before.
            resource_tracker.ensure_running()
            before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP))
            try:
                results = parallel(calls)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            yield from results


@contextmanager
def workers(stop: Path, jobs: int | None = None, cluster: str | None = None) -> Iterator[Workers]:
    """Workers while this lasts.

    stop: a file that tells them to stop, on this machine; it is removed at the end, and at the
        beginning, as one that was killed leaves it
    jobs: processes at a time; None is one per core
    cluster: address of a Dask scheduler whose workers compute instead

    Raises `FishdError` where there is no scheduler.
    """
    if cluster is None and multiprocessing is None:
        raise FishdError(
            "processes that compute need semaphores, which cannot be made here: /dev/shm is "
            "missing or not writable; mount it: sudo mount -t tmpfs shm /dev/shm"
        )
    with _scheduler(cluster) as event, SafeChildren():
        asks = Stop(event.name, True) if event else Stop(str(stop), False)
        stop.unlink(missing_ok=True)
        try:
            yield Workers(asks, jobs, cluster, event)
        finally:
            stop.unlink(missing_ok=True)


def _numbered(function: Callable[[T], R], index: int, task: T) -> tuple[int, R]:
    return index, function(task)


@contextmanager
def _scheduler(address: str | None) -> Iterator[Any]:
    """A connection to the scheduler, and an event there that means stop; None without address."""
    if address is None:
        yield None
        return
    from distributed import Client, Event

    try:
        client = Client(address, timeout=CONNECT, name="fishctl")
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise FishdError(f"no Dask scheduler answers at {address}: {error}") from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise FishdError(f"the Dask scheduler at {address} has no workers")
        yield Event(f"fishd-stop-{uuid4().hex}", client=client)


def _event_set(name: str) -> Callable[[], bool]:
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
