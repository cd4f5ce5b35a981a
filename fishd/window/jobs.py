"""Experiments of the page: the verbs of fishctl as child processes, with progress and stop.

A child ends with this process, and an experiment returns the fish at its end. One that ended with a
window that was killed is among the runs, unfinished, and can be resumed there.
"""

import asyncio
import os
import signal
import time
from collections.abc import Callable, Iterable, Set
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.core import files, text
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError
from fishd.core.experiments import (
    EXPERIMENT_PREFIX,
    PROGRESS_PREFIX,
    CurvePoint,
    Form,
    Plan,
    Progress,
)
from fishd.window.children import JobError, spawn
from fishd.window.exports import read_curve
from fishd.window.forms import Forms
from fishd.window.job_options import ResumeOptions, list_words, swims
from fishd.window.runs import Runs

MAX_RUNNING_JOBS = 4
MAX_REMEMBERED_JOBS = 20
MAX_LINES = 50
MAX_POINTS = 200
MAX_OUTPUT_BYTES = 4 * 2**20
STOP_TIMEOUT_S = 5.0
"""Time from SIGINT to SIGTERM, and from that to SIGKILL [s]."""
CLOSE_TIMEOUT_S = 3.0 * STOP_TIMEOUT_S
"""Longest wait for the ends of all jobs [s]."""
TELL_DELAY_S = 0.2
"""Time for which lines of a job are gathered before pages get them [s]."""
_FOLDER_KINDS = ("record", "rerun")
"""Kinds of jobs whose option `--folder` is that of all runs."""


class Job(Struct):
    """A job as pages see it."""

    id: str
    kind: str
    fish: str
    command: list[str]
    """Words that a person would type."""
    state: Literal["running", "done", "failed", "stopped", "dismissed"]
    """`dismissed`: it is no longer listed."""
    elapsed: float
    """Time since its start, until its end at most [s]."""
    run: str = ""
    """Name of the folder of an experiment."""
    plan: Plan | None = None
    progress: Progress | None = None
    points: list[CurvePoint] = []
    """Curve of its results until now."""
    lines: list[str] = []
    result: Any = None
    exit: int | None = None
    resumable: bool = False
    """Whether it ended before it was complete, and can be resumed."""


class _Report(Struct):
    """Line of an experiment about its progress."""

    progress: Progress


_decode_report: Callable[[bytes], _Report] = decoder(_Report)


class Jobs:
    """The jobs of a window; use it in one event loop."""

    def __init__(
        self,
        runs: Path,
        scratch: Path,
        tell: Callable[[Job], None],
        show_folder: bool = False,
    ) -> None:
        """
        runs: folder of recordings and experiments
        scratch: folder for what jobs leave for this window only
        tell: receives a job that has changed
        show_folder: whether the commands that pages show name the folder
        """
        self._tell_pages, self._show_folder = tell, show_folder
        self._jobs: dict[str, Job] = {}
        self._starts: dict[str, float] = {}
        """Start of each job that runs [s, monotonic]."""
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._owners: dict[str, str] = {}
        """Identifier of the device that started each job that runs."""
        self._stopping: set[str] = set()
        self._pending: set[str] = set()
        self._count = 0
        self._scratch = scratch
        self.runs, self.forms = Runs(runs, scratch), Forms(runs)
        self._folder = runs
        self._starting = asyncio.Lock()

    async def close(self) -> None:
        """Stop all jobs, and wait for their ends, but not for a disk that stalls."""
        for name in list(self._tasks):
            self.stop(name)
        if self._tasks:
            await asyncio.wait(self._tasks.values(), timeout=CLOSE_TIMEOUT_S)

    def all(self) -> list[Job]:
        """Return all jobs, the oldest first."""
        return [self._with_elapsed_time(job) for job in self._jobs.values()]

    def _with_elapsed_time(self, job: Job) -> Job:
        if job.id in self._starts:
            job.elapsed = time.monotonic() - self._starts[job.id]
        return job

    def _tell(self, job: Job) -> None:
        self._tell_pages(self._with_elapsed_time(job))

    def _conclude(self, job: Job) -> bool:
        """Return whether an experiment that has ended is complete; else it can be resumed.

        A complete one may end with status 1, such as a search that has used up its time.
        """
        header = self.runs.read_header(job.run) if job.run else None
        job.resumable = header is not None and not header.ended and job.exit != 0
        return job.exit == 0 or bool(header and header.ended)

    def _new_id(self) -> str:
        self._count += 1
        return str(self._count)

    async def start(
        self,
        form: Form | None,
        fish: str,
        endpoint: Iterable[str],
        options: Any,
        device: str,
        check: Callable[[], object],
        plan: Plan | None = None,
    ) -> Job:
        """Start a job; raise `JobError`.

        form: None for an experiment that is resumed
        fish: name of the fish; endpoint: options of fishctl for it
        device: identifier of the device that starts it
        check: raises `FishdError` if that may no longer start it; the disk may have to wait
        """
        async with self._starting:
            if len(self._tasks) >= MAX_RUNNING_JOBS:
                raise JobError(f"{MAX_RUNNING_JOBS} jobs run already; wait for the end of one")
            # A disk may stall, and an emergency stop must not wait for it.
            job, words = await asyncio.to_thread(self._prepare, form, options, fish, [*endpoint])
            check()
            job.plan = plan
            return self._start_prepared(job, words, device, is_resumed=form is None)

    def _prepare(
        self, form: Form | None, options: Any, fish: str, endpoint: list[str]
    ) -> tuple[Job, list[str]]:
        """Return a job whose folders exist then, and the arguments of fishctl."""
        with files.os_errors(JobError, f"{self._folder} cannot be created"):
            self._folder.mkdir(parents=True, exist_ok=True)
        if form is None:
            return self._resume(options, fish, endpoint)
        kind = form.kind
        run = f"{kind}-{datetime.now():%Y%m%d-%H%M%S}" if swims(form, options) else ""
        words = list_words(form, options)
        if kind == "record" or getattr(options, "on", "") == "live":
            words += endpoint
        shown = [f"--folder={self._folder}"] if self._show_folder and kind in _FOLDER_KINDS else []
        job = Job(self._new_id(), kind, fish, ["fishctl", *words, *shown], "running", 0.0)
        job.run = self._unused_run(run) if run else ""
        if form.is_experiment:
            words.append(f"--on={options.on}")
        return job, [*words, *self._list_hidden_words(job), "--json"]

    def _start_prepared(self, job: Job, words: list[str], device: str, *, is_resumed: bool) -> Job:
        name = job.id
        if is_resumed:
            for earlier in self._jobs.values():
                if earlier.run == job.run and earlier.resumable:
                    earlier.resumable = False
                    self._tell(earlier)
        self._jobs[name], self._starts[name] = job, time.monotonic()
        while len(self._jobs) > MAX_REMEMBERED_JOBS:
            ended = next((j.id for j in self._jobs.values() if j.state != "running"), None)
            if ended is None:
                break
            del self._jobs[ended]
        self._owners[name] = device
        self._tasks[name] = asyncio.create_task(self._run(job, words))
        return job

    def _resume(
        self, options: ResumeOptions, fish: str, endpoint: list[str]
    ) -> tuple[Job, list[str]]:
        """Return the job and the arguments of an experiment that is resumed."""
        header = self.runs.read_header(options.run)
        if header is None or header.ended:
            raise JobError(f"{options.run} is not an experiment that can be resumed")
        words = [*header.kind.split(), "--resume", str(self._folder / options.run)]
        words += (["--take"] if options.take else []) + (endpoint if header.on == "live" else [])
        kind = header.kind.partition(" ")[0]
        job = Job(self._new_id(), kind, fish, ["fishctl", *words], "running", 0.0, options.run)
        return job, [*words, "--json"]

    def _unused_run(self, name: str) -> str:
        """Return the name of a folder that does not exist; two jobs may start in one second."""
        runs = {job.run for job in list(self._jobs.values())}
        return files.unused_name(
            name, lambda name: name in runs or os.path.lexists(self._folder / name)
        )

    def _list_hidden_words(self, job: Job) -> list[str]:
        """Return the arguments that serve this window only: where a job leaves its results."""
        if job.kind in _FOLDER_KINDS:
            return [f"--folder={self._folder}"]
        if job.kind == "simulate":
            return [f"--record={self._recording_of(job)}"]
        return [f"--folder={self._folder / job.run}"] if job.run else []

    def _recording_of(self, job: Job) -> Path:
        """Return the path of the recording of a simulated fish."""
        return self._scratch / f"simulate-{job.id}.mcap"

    def stop(self, name: str) -> Job:
        """Interrupt a job as Ctrl-C does: an experiment lets the fish rest first."""
        job = self._find(name)
        if name in self._tasks and name not in self._stopping:
            self._stopping.add(name)
            self._signal(name, signal.SIGINT)
            loop = asyncio.get_running_loop()
            loop.call_later(STOP_TIMEOUT_S, self._signal, name, signal.SIGTERM)
            loop.call_later(2.0 * STOP_TIMEOUT_S, self._signal, name, signal.SIGKILL)
        return job

    def dismiss(self, name: str) -> Job:
        """Remove a job that has ended from the list; its run is kept; raise `JobError`."""
        job = self._find(name)
        if job.state == "running":
            raise JobError("this job runs; stop it first")
        job.state = "dismissed"
        return self._jobs.pop(name)

    def _find(self, name: str) -> Job:
        if job := self._jobs.get(name):
            return job
        raise JobError(f"there is no job '{text.quoted(name)}'")

    def stop_without_access(self, paired: Set[str]) -> None:
        """Stop the jobs of devices that are not among the paired ones, by their identifiers."""
        for name, device in self._owners.items():
            if device not in paired and name not in self._stopping:
                self._jobs[name].lines.append("stopped: the device that started it was revoked")
                self.stop(name)

    def _signal(self, name: str, number: signal.Signals) -> None:
        if process := self._processes.get(name):
            with suppress(ProcessLookupError):
                process.send_signal(number)

    async def _run(self, job: Job, words: list[str]) -> None:
        try:
            output = await self._run_child(job, words)
            with suppress(msgspec.DecodeError):
                job.result = msgspec.json.decode(output)
            if job.kind == "simulate" and job.exit == 0:
                curve = await read_curve(self._recording_of(job), self._folder)
                job.result = {**job.result, "curve": curve}
            stopped = job.id in self._stopping
            is_complete = await asyncio.to_thread(self._conclude, job)
            job.state = "stopped" if stopped else "done" if is_complete else "failed"
        except (OSError, FishdError) as error:
            job.lines.append(text.describe_error(error))
            job.state = "failed"
        finally:
            self._with_elapsed_time(job)
            self._starts.pop(job.id, None)
            self._tasks.pop(job.id, None)
            self._owners.pop(job.id, None)
            self._stopping.discard(job.id)
            self.runs.forget()
            self._tell(job)

    async def _run_child(self, job: Job, words: list[str]) -> bytes:
        """Run fishctl; return its output."""
        process = await spawn(words, self._folder)
        self._processes[job.id] = process
        if job.id in self._stopping:
            self._signal(job.id, signal.SIGINT)
        assert process.stdout
        assert process.stderr
        try:
            output, _ = await asyncio.gather(
                _read_all(process.stdout), self._read_lines(job, process.stderr)
            )
            job.exit = await process.wait()
        finally:
            del self._processes[job.id]
        return output

    async def _read_lines(self, job: Job, stream: asyncio.StreamReader) -> None:
        rest = b""
        while chunk := await stream.read(4096):
            *lines, rest = (rest + chunk)[-(2**16) :].split(b"\n")
            for line in lines:
                _take_line(job, line)
            self._tell_later(job)
        if rest:
            _take_line(job, rest)

    def _tell_later(self, job: Job) -> None:
        def tell() -> None:
            self._pending.discard(job.id)
            self._tell(job)

        if job.id not in self._pending:
            self._pending.add(job.id)
            asyncio.get_running_loop().call_later(TELL_DELAY_S, tell)


def _take_line(job: Job, line: bytes) -> None:
    """Add a line of a job: its progress, or a text."""
    if line.startswith(EXPERIMENT_PREFIX):  # the next one of a queue
        job.progress, job.points = None, []
    if line.startswith(PROGRESS_PREFIX):
        with suppress(msgspec.DecodeError):
            progress, before = _decode_report(line).progress, job.progress
            job.points += [progress.point] if progress.point else []
            del job.points[:-MAX_POINTS]
            estimates = progress.estimates or (before and before.estimates)
            job.progress = replace(progress, estimates=estimates, point=None)
            return
    job.lines.append(text.line(line.decode("utf-8", "replace")))
    del job.lines[:-MAX_LINES]


async def _read_all(stream: asyncio.StreamReader) -> bytes:
    """Return the output of a process, up to `MAX_OUTPUT_BYTES`."""
    parts, size = [], 0
    while chunk := await stream.read(2**16):
        if size < MAX_OUTPUT_BYTES:
            parts.append(chunk)
        size += len(chunk)
    return b"".join(parts)
