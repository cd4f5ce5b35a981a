"""Experiments of the page: the verbs of fishctl as child processes, with progress and stop.

A child ends with this process, and an experiment returns the fish at its end. What was lost with a
window that was killed is among the jobs of its successor.
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

from fishd.core import files, text
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError
from fishd.window.children import JobError, spawn
from fishd.window.curves import read_curve
from fishd.window.job_options import DRIVING_KINDS, QUEUE, ResumeOptions, list_words
from fishd.window.runs import Runs

MAX_RUNNING_JOBS = 4
MAX_REMEMBERED_JOBS = 20
MAX_LINES = 50
MAX_OUTPUT_BYTES = 4 * 2**20
STOP_TIMEOUT_S = 5.0
"""Time from SIGINT to SIGTERM, and from that to SIGKILL [s]."""
CLOSE_TIMEOUT_S = 3.0 * STOP_TIMEOUT_S
"""Longest wait for the ends of all jobs [s]."""
TELL_DELAY_S = 0.2
"""Time for which lines of a job are gathered before pages get them [s]."""
_RESUMABLE = ("measure", "sweep", "compare")
"""Kinds of experiments that a page resumes."""
_FOLDER_KINDS = ("record", "rerun")
"""Kinds of jobs whose option `--folder` is that of all runs."""


class Job(Struct):
    """A job as pages see it."""

    id: str
    kind: str
    fish: str
    command: list[str]
    """Words that a person would type."""
    state: Literal["running", "done", "failed", "stopped", "lost", "dismissed"]
    """`lost`: its window was killed; `dismissed`: it is no longer listed."""
    elapsed: float
    """Time since its start, until its end at most [s]."""
    run: str = ""
    """Name of the folder of an experiment."""
    lines: list[str] = []
    result: Any = None
    exit: int | None = None
    resumable: bool = False
    """Whether it ended before it was complete, and can be resumed."""


_decode_job: Callable[[bytes], Job] = decoder(Job)


class Jobs:
    """The jobs of a window; use it in one event loop."""

    def __init__(
        self,
        runs: Path,
        scratch: Path,
        tell: Callable[[Job], None],
        keep: Callable[[list[Job]], object],
        show_folder: bool = False,
    ) -> None:
        """
        runs: folder of recordings and experiments
        scratch: folder for what jobs leave for this window only
        tell: receives a job that has changed
        keep: receives the jobs that run, where one begins or ends
        show_folder: whether the commands that pages show name the folder
        """
        self._tell_pages, self._keep, self._show_folder = tell, keep, show_folder
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
        self.runs = Runs(runs, scratch)
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

    def take_lost(self, lost: Iterable[msgspec.Raw]) -> None:
        """List the jobs of a window that was killed, each with what is left of it."""
        for payload in lost:
            with suppress(msgspec.DecodeError):
                job = _decode_job(payload)
                job.id, job.state = self._new_id(), "lost"
                job.lines = [self._describe_remains(job)]
                self._jobs[job.id] = job

    def _describe_remains(self, job: Job) -> str:
        """Return what is left of a job that was lost; mark it done or resumable if it is."""
        what = "fishd-window was killed while this ran"
        if job.kind == QUEUE:
            return f"{what}, and the fish came to rest; the queue waits for a start"
        if job.kind in DRIVING_KINDS:
            self._conclude(job)
            if job.state == "done":
                return "fishd-window was killed, but this was complete"
            rests = f"{what}, and the fish came to rest"
            kept = f"what was measured until then is in {job.run}"
            return f"{rests}; {kept if job.resumable else 'nothing was measured yet'}"
        if job.kind == "record":
            return f"{what}; what was recorded until then is among the runs"
        return f"{what}; start it again"

    def _conclude(self, job: Job) -> None:
        """Find out whether an experiment that has ended is complete, or can be resumed."""
        header = self.runs.read_header(job.run) if job.run else None
        if header is None or header.on != "live" or header.kind not in _RESUMABLE:
            return
        if not header.ended:
            job.resumable = True
        elif job.state == "lost":
            job.state = "done"
            with suppress(files.FileProblem, msgspec.DecodeError):
                path = self._folder / job.run / "result.json"
                job.result = decoder(Any)(files.read(path, MAX_OUTPUT_BYTES, "a result"))

    def _new_id(self) -> str:
        self._count += 1
        return str(self._count)

    async def start(
        self,
        kind: str,
        fish: str,
        endpoint: Iterable[str],
        options: Any,
        device: str,
        check: Callable[[], object],
    ) -> Job:
        """Start a job; raise `JobError`.

        fish: name of the fish; endpoint: options of fishctl for it
        device: identifier of the device that starts it
        check: raises `FishdError` if that may no longer start it; the disk may have to wait
        """
        async with self._starting:
            if len(self._tasks) >= MAX_RUNNING_JOBS:
                raise JobError(f"{MAX_RUNNING_JOBS} jobs run already; wait for the end of one")
            # A disk may stall, and an emergency stop must not wait for it.
            prepared = await asyncio.to_thread(self._prepare, kind, options)
            check()
            return self._start_prepared(*prepared, fish, endpoint, options, device)

    def _prepare(self, kind: str, options: Any) -> tuple[str, str, list[str]]:
        """Return kind, folder and command line of a job, whose folders exist then."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise JobError(f"{self._folder} cannot be created: {error.strerror}") from None
        if kind == "resume":
            return self._resume(options)
        has_folder = kind in DRIVING_KINDS and kind != QUEUE
        run = f"{kind}-{datetime.now():%Y%m%d-%H%M%S}" if has_folder else ""
        return kind, self._unused_run(run) if run else "", list_words(kind, options)

    def _start_prepared(
        self,
        kind: str,
        run: str,
        words: list[str],
        fish: str,
        endpoint: Iterable[str],
        options: Any,
        device: str,
    ) -> Job:
        is_resumed = isinstance(options, ResumeOptions)
        if is_resumed:
            for job in self._jobs.values():
                if job.run == run and job.resumable:
                    job.resumable = False
                    self._tell(job)
        if kind in ("record", *DRIVING_KINDS):
            words += endpoint
        shown = [f"--folder={self._folder}"] if self._show_folder and kind in _FOLDER_KINDS else []
        name = self._new_id()
        job = Job(name, kind, fish, ["fishctl", *words, *shown], "running", 0.0, run)
        words += self._list_hidden_words(job, is_resumed=is_resumed)
        self._jobs[name], self._starts[name] = job, time.monotonic()
        while len(self._jobs) > MAX_REMEMBERED_JOBS:
            ended = next((j.id for j in self._jobs.values() if j.state != "running"), None)
            if ended is None:
                break
            del self._jobs[ended]
        self._keep_running()
        self._owners[name] = device
        self._tasks[name] = asyncio.create_task(self._run(job, words))
        return job

    def _resume(self, options: ResumeOptions) -> tuple[str, str, list[str]]:
        """Return kind, folder and command line of an experiment that is resumed."""
        header = self.runs.read_header(options.run)
        if header is None or header.kind not in _RESUMABLE or header.on != "live":
            raise JobError(f"{options.run} is not an experiment that this page can resume")
        words = [header.kind, "--resume", str(self._folder / options.run)]
        return header.kind, options.run, words + (["--take"] if options.take else [])

    def _unused_run(self, name: str) -> str:
        """Return the name of a folder that does not exist; two jobs may start in one second."""
        runs = {job.run for job in list(self._jobs.values())}
        return files.unused_name(
            name, lambda name: name in runs or os.path.lexists(self._folder / name)
        )

    def _list_hidden_words(self, job: Job, *, is_resumed: bool) -> list[str]:
        """Return the arguments that serve this window only: where a job leaves its results."""
        if job.kind in _FOLDER_KINDS:
            return [f"--folder={self._folder}", "--json"]
        if job.kind == "simulate":
            return [f"--record={self._recording_of(job)}", "--json"]
        if job.kind == QUEUE:
            return ["--json"]
        place = [] if is_resumed else ["--on=live", f"--folder={self._folder / job.run}"]
        return [*place, "--json"]

    def _recording_of(self, job: Job) -> Path:
        """Return the path of the recording of a simulated fish."""
        return self._scratch / f"simulate-{job.id}.mcap"

    def _keep_running(self) -> None:
        self._keep([job for job in self._jobs.values() if job.state == "running"])

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
            await asyncio.to_thread(self._conclude, job)
            job.state = "stopped" if stopped else "done" if job.exit == 0 else "failed"
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
            self._keep_running()
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
            job.lines += [text.line(line.decode("utf-8", "replace")) for line in lines]
            del job.lines[:-MAX_LINES]
            self._tell_later(job)
        if rest:
            job.lines.append(text.line(rest.decode("utf-8", "replace")))

    def _tell_later(self, job: Job) -> None:
        def tell() -> None:
            self._pending.discard(job.id)
            self._tell(job)

        if job.id not in self._pending:
            self._pending.add(job.id)
            asyncio.get_running_loop().call_later(TELL_DELAY_S, tell)


async def _read_all(stream: asyncio.StreamReader) -> bytes:
    """Return the output of a process, up to `MAX_OUTPUT_BYTES`."""
    parts, size = [], 0
    while chunk := await stream.read(2**16):
        if size < MAX_OUTPUT_BYTES:
            parts.append(chunk)
        size += len(chunk)
    return b"".join(parts)
