"""The workers of a Dask cluster, in place of processes on this machine."""

import asyncio
import logging
import platform
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, TypeVar
from uuid import uuid4

import distributed
import numpy as np
from distributed.scheduler import KilledWorker
from distributed.versions import VersionMismatchWarning

from fishd import __version__
from fishd.core.errors import FishdError
from fishd.lab.workers import Unfinished

T = TypeVar("T")
R = TypeVar("R")

CONNECT_TIMEOUT_S = 10.0
"""Timeout of the connection to a scheduler, and of the first answer of its workers [s]."""
NO_WORKER_TIMEOUT_S = 8.0
"""Time without a worker after which a computation ends: a killed one may be started again [s]."""
_ANSWER_TIMEOUT_S = 10.0
"""Timeout of the scheduler's answers during a computation [s]."""
_CLOSE_TIMEOUT_S = 0.5
_WATCH_INTERVAL_S = 0.25
_POLL_INTERVAL_S = 1.0
"""Interval at which a worker asks the scheduler whether to stop [s]."""
_LOGS = ("distributed", "distributed.client", "tornado.application", "asyncio")
"""Logs in which Dask reports what this module reports in its own words."""
_ENDED = "its scheduler has ended, or cannot be reached"
_REMEDY = "give the address from the scheduler's log, such as tcp://HOST:8786"
_SILENT = f"what listens there is silent, like a dashboard or another program; {_REMEDY}"


class EventStop(NamedTuple):
    """An event of the scheduler that means stop."""

    name: str

    def make_check(self) -> Callable[[], bool]:
        """Return a function, for use in a task on a worker, that returns whether to stop."""
        event = distributed.Event(self.name, client=distributed.get_client())
        was_set, next_look = False, 0.0

        def stop() -> bool:
            nonlocal was_set, next_look
            if not was_set and time.monotonic() >= next_look:
                was_set = event.is_set()
                next_look = time.monotonic() + _POLL_INTERVAL_S
            return was_set

        return stop


class Cluster:
    """The workers of a Dask cluster; see `connect`."""

    def __init__(self, client: Any, address: str, stop_timeout: float) -> None:
        """client: connected to the scheduler at `address`"""
        self.stop = EventStop(f"fishd-stop-{uuid4().hex}")
        self._client, self._address = client, address
        self._stop_timeout = stop_timeout
        self._stop_deadline: float | None = None

    def ask_to_stop(self) -> None:
        """Tell all tasks to stop, also those that have not started; returns immediately."""
        if self._stop_deadline is None:
            self._stop_deadline = time.monotonic() + self._stop_timeout
            event = distributed.Event(self.stop.name, client=self._client)
            self._client.loop.add_callback(event.set)

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield index and result of each task, in the order in which they end.

        function: function at the top level of a module; its argument and result are pickled

        Dask repeats the task of a worker that was killed. After `ask_to_stop`, this ends without
        the tasks that have not ended in time. Raises `Unfinished` where the cluster is lost or a
        task raises an exception.
        """
        versions = read_versions()
        left: dict[Any, int] = {}
        done: SimpleQueue[Any] = SimpleQueue()
        try:
            for index, task in enumerate(tasks):
                future = self._client.submit(_run_checked, versions, function, task, pure=False)
                left[future] = index
                future.add_done_callback(done.put)
            last_worker = next_look = time.monotonic()
            while left:
                with suppress(Empty):
                    future = done.get(timeout=_WATCH_INTERVAL_S)
                    result = future.result()
                    yield left.pop(future), result
                if (now := time.monotonic()) < next_look:
                    continue
                has_workers = self._has_workers()
                next_look = time.monotonic() + _WATCH_INTERVAL_S
                last_worker = now if has_workers else last_worker
                if self._stop_deadline and (not has_workers or now > self._stop_deadline):
                    return
                if now > last_worker + NO_WORKER_TIMEOUT_S:
                    raise _Lost("no worker is left")
        except (Exception, asyncio.CancelledError) as error:
            message = f"the Dask cluster at {self._address}: {_describe(error)}"
            raise Unfinished(message, sorted(left.values())) from None

    def _has_workers(self) -> bool:
        """Return whether the scheduler has a worker; raises OSError where it does not answer."""
        count = self._client.scheduler.ncores
        return bool(self._client.sync(count, callback_timeout=_ANSWER_TIMEOUT_S))


def _open_client(address: str) -> Any:
    """Return a client of a scheduler whose workers have the versions of this machine.

    It connects in a separate thread, because Dask waits without a limit for a program that accepts
    the connection and is silent.
    """
    nothing = f"no Dask scheduler answers at {address}"
    place = "scheduler_file" if address.endswith(".json") else "address"
    cause = f"{nothing}: {_SILENT}"
    if place == "scheduler_file" and not Path(address).exists():
        cause = f"{nothing}: there is no such file"
    clients: list[Any] = []
    outcomes: list[Any] = []

    def open_client() -> None:
        nonlocal cause
        try:
            clients.append(
                distributed.Client(
                    **{place: address},
                    timeout=0.8 * CONNECT_TIMEOUT_S,
                    name="fishctl",
                )
            )
            cause = f"the Dask scheduler at {address} has no workers; start some"
            clients[0].wait_for_workers(1, timeout=CONNECT_TIMEOUT_S)
            cause = f"the workers of the Dask cluster at {address} do not answer"
            answers = clients[0].run(read_versions, on_error="return")
            # The scheduler reads each task before a worker does.
            try:
                answers["its scheduler"] = clients[0].run_on_scheduler(read_versions)
            except ImportError as error:
                answers["its scheduler"] = error
            outcomes.append(answers)
        except Exception as error:
            outcomes.append(error)

    thread = threading.Thread(target=open_client, daemon=True)
    thread.start()
    thread.join(CONNECT_TIMEOUT_S)
    if clients:  # as long again for the workers
        thread.join(CONNECT_TIMEOUT_S)
    outcome = outcomes[0] if outcomes else TimeoutError()
    try:
        if isinstance(outcome, TimeoutError):
            raise Unfinished(cause)
        if isinstance(outcome, OSError):
            raise Unfinished(f"{nothing}: cannot connect; {_REMEDY}")
        if isinstance(outcome, ValueError):
            raise Unfinished(f"{nothing}: {outcome}; {_REMEDY}")
        if isinstance(outcome, Exception):
            raise Unfinished(f"{nothing}: another program listens there; {_REMEDY}")
        _check_versions(outcome)
    except Unfinished:
        for client in clients:
            _close(client)
        raise
    return clients[0]


class _Lost(FishdError):
    """The cluster cannot continue."""


@contextmanager
def connect(address: str, stop_timeout: float) -> Iterator[Cluster]:
    """Provide the workers of a Dask cluster while this lasts.

    address: address of the scheduler, or the path of its file, which ends in .json
    stop_timeout: time after `ask_to_stop` in which results of running tasks are received [s]

    Raises `Unfinished` where no scheduler answers, where it has no workers, and where workers have
    other versions than this machine.
    """
    with _quiet():
        client = _open_client(address)
        try:
            yield Cluster(client, address, stop_timeout)
        finally:
            _close(client)


def _close(client: Any) -> None:
    with suppress(Exception):  # the scheduler may have ended
        client.close(_CLOSE_TIMEOUT_S)


def read_versions() -> dict[str, str]:
    """Return the versions on which results may depend, by name; called on each worker, too."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"fishd": __version__, "Python": python, "numpy": np.__version__}


def _describe(error: BaseException) -> str:
    """Return the message for an error that ends a computation."""
    if isinstance(error, _Lost):
        return str(error)
    if isinstance(error, OSError | asyncio.CancelledError | CancelledError):
        return _ENDED
    if isinstance(error, KilledWorker):
        return (
            f"{error.allowed_failures + 1} workers ended during the same task, most likely because "
            f"memory ran out; the last one is {error.last_worker.address}"
        )
    if isinstance(error, FishdError):
        return f"on a worker: {error}"
    return f"a worker failed: {type(error).__name__}: {error}"


def _run_checked(versions: dict[str, str], function: Callable[[T], R], task: T) -> R:
    """Run a task on a worker, which may have joined after the start, if it has these versions."""
    _check_versions({distributed.get_worker().address: read_versions()}, versions)
    return function(task)


def _check_versions(answers: Mapping[str, Any], here: Mapping[str, str] | None = None) -> None:
    """Raise `Unfinished` for workers with other versions than this machine.

    answers: versions, or the exception of reading them, by the address of the worker
    """
    here = here or read_versions()
    workers: dict[str, list[str]] = {}
    for worker, there in answers.items():
        if isinstance(there, Exception):
            what = f"fishd cannot be used there: {there}"
        elif differences := [name for name in here if there[name] != here[name]]:
            names = (f"{name} {there[name]} (here {here[name]})" for name in differences)
            what = ", ".join(names)
        else:
            continue
        workers.setdefault(what, []).append(worker)
    if workers:
        parts = (
            f"{several[0]}{f' and {len(several) - 1} more' if several[1:] else ''}: {what}"
            for what, several in workers.items()
        )
        raise Unfinished(
            f"the Dask cluster differs from this machine: {'; '.join(parts)}; install the same "
            "versions of fishd, Python and numpy on all machines, and restart scheduler and workers"
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the logs and warnings of Dask."""
    logs = [logging.getLogger(name) for name in _LOGS]
    levels = [log.level for log in logs]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)
        for log in logs:
            log.setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            for log, level in zip(logs, levels, strict=True):
                log.setLevel(level)
