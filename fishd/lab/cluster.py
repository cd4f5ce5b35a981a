"""The workers of a Dask cluster, in place of processes on this machine.

The connection has an event loop in a separate thread. So each wait has a limit, also for a program
that accepts the connection and is silent, for which Dask has none; and signals are handled
meanwhile.
"""

import asyncio
import logging
import platform
import threading
import time
import warnings
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
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
_ANSWER_TIMEOUT_S = 4.0
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

_Outcomes = SimpleQueue[tuple[int, Any] | BaseException | None]
"""Index and result of each task; an error that ends the computation; None after a signal."""


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

    def __init__(self, address: str, stop_timeout: float) -> None:
        """See `connect`, which also opens the connection."""
        self.stop = EventStop(f"fishd-stop-{uuid4().hex}")
        self._address = address
        self._stop_timeout = stop_timeout
        self._client: Any = None
        self._stop_deadline: float | None = None
        self._closing = asyncio.Event()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run_loop, daemon=True)
        self._thread.start()

    def ask_to_stop(self) -> None:
        """Tell all tasks to stop, also those that have not started; returns immediately."""
        if self._stop_deadline is None:
            self._stop_deadline = time.monotonic() + self._stop_timeout
            self._start(self._set_stop())

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield index and result of each task, in the order in which they end.

        function: function at the top level of a module; its argument and result are pickled

        Dask repeats the task of a worker that was killed. After `ask_to_stop`, this ends without
        the tasks that have not ended in time. Raises `Unfinished` where the cluster is lost or a
        task raises an exception.
        """
        unfinished = set(range(len(tasks)))
        outcomes: _Outcomes = SimpleQueue()
        computation = self._start(self._compute(function, tasks, outcomes))
        try:
            while unfinished:
                outcome = outcomes.get()
                if outcome is None:
                    return
                if isinstance(outcome, BaseException):
                    message = f"the Dask cluster at {self._address}: {_describe(outcome)}"
                    raise Unfinished(message, sorted(unfinished)) from None
                unfinished.remove(outcome[0])
                yield outcome
        finally:
            computation.cancel()

    def open(self) -> None:
        """Connect, and compare versions; raises `Unfinished`."""
        self._start(self._connect()).result()

    def close(self) -> None:
        """Close the connection, with a time limit."""
        self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join(2.0 * _CLOSE_TIMEOUT_S)

    def _run_loop(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._keep_open())

    async def _keep_open(self) -> None:
        await self._closing.wait()
        with suppress(Exception):
            await asyncio.wait_for(self._client.close(), _CLOSE_TIMEOUT_S)

    def _start(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        """Start a coroutine in the thread of the connection; return its concurrent future."""
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop)

    async def _connect(self) -> None:
        place = "scheduler_file" if self._address.endswith(".json") else "address"
        nothing = f"no Dask scheduler answers at {self._address}"
        cause = f"{nothing}: {_SILENT}"
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                self._client = distributed.Client(
                    **{place: self._address},
                    asynchronous=True,
                    set_as_default=False,
                    timeout=0.8 * CONNECT_TIMEOUT_S,
                    name="fishctl",
                )
                await self._client
                cause = f"the Dask scheduler at {self._address} has no workers; start some"
                while not await self._client.nthreads():
                    await asyncio.sleep(0.1)
                cause = f"the workers of the Dask cluster at {self._address} do not answer"
                answers = await self._client.run(read_versions, on_error="return")
                answers["its scheduler"] = await self._read_scheduler_versions()
        except TimeoutError:
            if place == "scheduler_file" and not Path(self._address).exists():
                cause = f"{nothing}: there is no such file"
            raise Unfinished(cause) from None
        except OSError:
            raise Unfinished(f"{nothing}: cannot connect; {_REMEDY}") from None
        except ValueError as error:
            raise Unfinished(f"{nothing}: {error}; {_REMEDY}") from None
        except Exception:
            raise Unfinished(f"{nothing}: another program listens there; {_REMEDY}") from None
        _check_versions(answers)

    async def _read_scheduler_versions(self) -> dict[str, str] | ImportError:
        """Return the versions of the scheduler, which reads each task before a worker does."""
        try:
            versions: dict[str, str] = await self._client.run_on_scheduler(read_versions)
        except ImportError as error:
            return error
        return versions

    async def _set_stop(self) -> None:
        await distributed.Event(self.stop.name, client=self._client).set()

    async def _compute(
        self, function: Callable[[T], R], tasks: Sequence[T], outcomes: _Outcomes
    ) -> None:
        versions = read_versions()

        async def compute(index: int, task: T) -> None:
            future = self._client.submit(_run_checked, versions, function, task, pure=False)
            try:
                result = await future
            except (Exception, asyncio.CancelledError):
                if future.cancelled():
                    raise _Lost(_ENDED) from None
                raise
            outcomes.put((index, result))

        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._watch(outcomes))
                for index, task in enumerate(tasks):
                    group.create_task(compute(index, task))
        except BaseExceptionGroup as errors:
            outcomes.put(errors.exceptions[0])

    async def _watch(self, outcomes: _Outcomes) -> None:
        """Raise `_Lost` when the cluster is lost; end the computation when it is time to stop."""
        last_worker = time.monotonic()
        while True:
            await asyncio.sleep(_WATCH_INTERVAL_S)
            try:
                workers = await asyncio.wait_for(self._client.nthreads(), _ANSWER_TIMEOUT_S)
            except OSError:
                raise _Lost(_ENDED) from None
            now = time.monotonic()
            if workers:
                last_worker = now
            elif now > last_worker + NO_WORKER_TIMEOUT_S:
                raise _Lost("no worker is left")
            if self._stop_deadline and (not workers or now > self._stop_deadline):
                outcomes.put(None)


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
        cluster = Cluster(address, stop_timeout)
        try:
            cluster.open()
            yield cluster
        finally:
            cluster.close()


def read_versions() -> dict[str, str]:
    """Return the versions on which results may depend, by name; called on each worker, too."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"fishd": __version__, "Python": python, "numpy": np.__version__}


def _describe(error: BaseException) -> str:
    """Return the message for an error that ends a computation."""
    if isinstance(error, _Lost):
        return str(error)
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
