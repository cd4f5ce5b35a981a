"""Experiments of the page: the verbs of fishctl as child processes, with progress and stop.

A page gives no words of a command line, only values that are checked here. A child ends with this
process, and an experiment returns the fish at its end.
"""

import asyncio
import csv
import os
import re
import shlex
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from fishd.core import text
from fishd.core.errors import FishdError
from fishd.core.process.safe_path import python_command
from fishd.core.schema import PRINTABLE

MAX_RUNNING_JOBS = 4
MAX_REMEMBERED_JOBS = 20
MAX_LINES = 50
MAX_OUTPUT_BYTES = 4 * 2**20
STOP_TIMEOUT_S = 5.0
"""Time from SIGINT to SIGTERM, and from that to SIGKILL [s]."""
TELL_DELAY_S = 0.2
"""Time for which lines of a job are gathered before pages get them [s]."""
RUNS_AGE_S = 1.0
"""Longest age of a list of runs [s]."""
MAX_WAITING_PLOTS = 8
_CHILD = """\
import ctypes, os, signal
ctypes.CDLL(None).prctl(1, int(signal.SIGTERM), 0, 0, 0)  # PR_SET_PDEATHSIG
os.nice(5)
from fishd.__main__ import fishctl
fishctl()
"""
_RUN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]*", re.A)
_CURVE = ("time", "fx", "fy", "phi_c", "alpha", "thrust")
"""Columns of a simulated run that a page draws."""

Name = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*\Z", max_length=60)]
Word = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.][A-Za-z0-9_.:,+=-]*\Z", max_length=200)]
RunName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. -]*\Z", max_length=100)]
Line = Annotated[str, Meta(pattern=PRINTABLE, max_length=200)]
Seconds = Annotated[float, Meta(gt=0, le=86400)]
Value = bool | int | float | Word | None


class JobError(FishdError):
    """A job cannot be started, or there is none."""


class RecordOptions(Struct, forbid_unknown_fields=True):
    """Options of record."""

    name: RunName | None = None
    seconds: Seconds | None = None
    note: Line = ""
    subject: Line = ""
    operator: Line = ""


class MeasureOptions(Struct, forbid_unknown_fields=True):
    """Options of measure."""

    controller: Name
    parameters: dict[Name, Value] = {}
    seconds: Seconds = 60.0
    take: bool = False


class SweepOptions(Struct, forbid_unknown_fields=True):
    """Options of sweep; a parameter may have several values, such as `1,1.5,2` or `0.4:4:0.2`."""

    controller: Name
    parameters: dict[Name, Value] = {}
    seconds: Seconds = 30.0
    take: bool = False


class CompareOptions(Struct, forbid_unknown_fields=True):
    """Options of compare."""

    contestants: Annotated[list[Word], Meta(max_length=20)] = []
    seconds: Seconds = 60.0
    runs: Annotated[int, Meta(ge=1, le=100)] = 1
    take: bool = False


class SimulateOptions(Struct, forbid_unknown_fields=True):
    """Options of simulate."""

    controller: Name
    parameters: dict[Name, Value] = {}
    seconds: Annotated[float, Meta(ge=2, le=600)] = 20.0


class RerunOptions(Struct, forbid_unknown_fields=True):
    """Options of rerun."""

    run: RunName
    controller: Name | None = None
    parameters: dict[Name, Value] = {}


KINDS: dict[str, type[Struct]] = {
    "record": RecordOptions,
    "measure": MeasureOptions,
    "sweep": SweepOptions,
    "compare": CompareOptions,
    "simulate": SimulateOptions,
    "rerun": RerunOptions,
}
"""Options of each kind of job."""
DRIVING_KINDS = {"measure", "sweep", "compare"}
"""Kinds of jobs that swim the fish."""


class Job(Struct):
    """A job as pages see it."""

    id: str
    kind: str
    fish: str
    command: list[str]
    state: Literal["running", "done", "failed", "stopped"]
    started: float
    """Time of the start [s, unix]."""
    lines: list[str] = []
    result: Any = None
    ended: float | None = None
    exit: int | None = None


class Jobs:
    """The jobs of a window; use it in one event loop."""

    def __init__(self, runs: Path, tell: Callable[[Job], None]) -> None:
        """
        runs: folder of recordings and experiments
        tell: receives a job that has changed
        """
        self.runs = runs
        self._tell = tell
        self._jobs: dict[str, Job] = {}
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._stopping: set[str] = set()
        self._pending: set[str] = set()
        self._count = 0
        self._cache = tempfile.TemporaryDirectory(prefix="fishd-window-")
        self._list: tuple[float, Any] = (-RUNS_AGE_S, [])
        self._listing, self._plotting = asyncio.Lock(), asyncio.Lock()
        self._waiting_plots = 0

    async def close(self) -> None:
        """Stop all jobs, and wait for their ends."""
        for name in list(self._tasks):
            self.stop(name)
        if self._tasks:
            await asyncio.wait(self._tasks.values())
        self._cache.cleanup()

    def all(self) -> list[Job]:
        """Return all jobs, the oldest first."""
        return list(self._jobs.values())

    def start(self, kind: str, fish: str, endpoint: Iterable[str], options: Any) -> Job:
        """Start a job; raise `JobError`.

        fish: name of the fish; endpoint: options of fishctl for it
        """
        if len(self._tasks) >= MAX_RUNNING_JOBS:
            raise JobError(f"{MAX_RUNNING_JOBS} jobs run already; wait for the end of one")
        try:
            self.runs.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise JobError(f"{self.runs} cannot be created: {error.strerror}") from None
        self._count += 1
        name = str(self._count)
        words = self._words(kind, name, list(endpoint), options)
        job = Job(name, kind, fish, ["fishctl", *words], "running", time.time())
        self._jobs[name] = job
        while len(self._jobs) > MAX_REMEMBERED_JOBS:
            ended = next((j.id for j in self._jobs.values() if j.state != "running"), None)
            if ended is None:
                break
            del self._jobs[ended]
        self._tasks[name] = asyncio.create_task(self._run(job, words))
        return job

    def stop(self, name: str) -> Job:
        """Interrupt a job as Ctrl-C does: an experiment lets the fish rest first."""
        job = self._jobs.get(name)
        if job is None:
            raise JobError(f"there is no job '{text.quoted(name)}'")
        if name in self._tasks and name not in self._stopping:
            self._stopping.add(name)
            self._signal(name, signal.SIGINT)
            loop = asyncio.get_running_loop()
            loop.call_later(STOP_TIMEOUT_S, self._signal, name, signal.SIGTERM)
            loop.call_later(2.0 * STOP_TIMEOUT_S, self._signal, name, signal.SIGKILL)
        return job

    def _signal(self, name: str, number: signal.Signals) -> None:
        if process := self._processes.get(name):
            with suppress(ProcessLookupError):
                process.send_signal(number)

    def _words(self, kind: str, name: str, endpoint: list[str], options: Any) -> list[str]:
        """Return the arguments of fishctl."""
        if kind == "record":
            texts = {"note": options.note, "subject": options.subject}
            words = ["record", *([options.name] if options.name else []), *endpoint]
            words += [f"--{key}={value}" for key, value in texts.items() if value]
            words += [f"--operator={options.operator}"] if options.operator else []
            words += [f"--for={options.seconds:g}"] if options.seconds else []
            return [*words, f"--folder={self.runs}", "--json"]
        if kind == "rerun":
            words = ["rerun", options.run, f"--folder={self.runs}", "--json"]
            words += [f"--controller={options.controller}"] if options.controller else []
            pairs = options.parameters.items()
            return [*words, *(f"{key}={_format_value(value)}" for key, value in pairs)]
        if kind == "compare":
            words = ["compare", *options.contestants, f"--runs={options.runs}"]
        else:
            pairs = options.parameters.items()
            words = [kind, options.controller]
            words += [f"--{key.replace('_', '-')}={_format_value(value)}" for key, value in pairs]
        words += [f"--for={options.seconds:g}", "--json"]
        if kind == "simulate":
            return [*words, f"--record={self._cache.name}/simulate-{name}.mcap"]
        folder = self.runs / f"{kind}-{datetime.now():%Y%m%d-%H%M%S}-{name}"
        words += ["--take"] if options.take else []
        words += ["--on=live", *endpoint, f"--folder={folder}"]
        return [*words, f"--plot={self._cache.name}/{folder.name}.png"]

    async def _run(self, job: Job, words: list[str]) -> None:
        try:
            output = await self._run_child(job, words)
            with suppress(msgspec.DecodeError):
                job.result = msgspec.json.decode(output)
            if job.kind == "simulate" and job.exit == 0:
                job.result = {**job.result, "curve": await self._read_curve(job.id)}
            self._keep_picture(job)
            stopped = job.id in self._stopping
            job.state = "stopped" if stopped else "done" if job.exit == 0 else "failed"
        except (OSError, FishdError) as error:
            job.lines.append(text.describe_error(error))
            job.state = "failed"
        finally:
            job.ended = time.time()
            self._tasks.pop(job.id, None)
            self._stopping.discard(job.id)
            self._list = (-RUNS_AGE_S, [])
            self._tell(job)

    def _keep_picture(self, job: Job) -> None:
        """Move the picture of an experiment into its folder."""
        for picture in Path(self._cache.name).glob(f"{job.kind}-*-{job.id}.png"):
            folder = self.runs / picture.stem
            if folder.is_dir():
                shutil.move(picture, folder / f"{job.kind}.png")

    async def _run_child(self, job: Job, words: list[str]) -> bytes:
        """Run fishctl; return its output."""
        process = self._processes[job.id] = await self._spawn(words)
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

    async def _spawn(self, words: list[str]) -> asyncio.subprocess.Process:
        return await asyncio.create_subprocess_exec(
            *python_command("-c", _CHILD, *words),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env={**os.environ, "FISHD_RUNS": str(self.runs), "PYTHONUNBUFFERED": "1"},
            start_new_session=True,  # Ctrl-C in this terminal is for the window
        )

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

    async def _read_curve(self, name: str) -> dict[str, list[float | None]]:
        """Return columns of a simulated run."""
        run, folder = Path(self._cache.name, f"simulate-{name}.mcap"), Path(self._cache.name, name)
        folder.mkdir()
        await self._call(["export", str(run), "--csv", f"--to={folder}", "--force"])
        try:
            return await asyncio.to_thread(_read_columns, next(folder.glob("*[!s].csv")))
        finally:
            run.unlink(missing_ok=True)
            shutil.rmtree(folder)

    async def _call(self, words: list[str]) -> bytes:
        """Run fishctl, and return its output; raise `JobError`."""
        process = await self._spawn(words)
        output, errors = await process.communicate()
        if process.returncode and not output:
            message = text.line(errors.decode("utf-8", "replace"))
            raise JobError(message or f"{shlex.join(words)} failed")
        return output

    async def list_runs(self) -> Any:
        """Return recordings and experiments as `fishctl runs --json` does; raise `JobError`."""
        async with self._listing:
            read, runs = self._list
            if time.monotonic() - read >= RUNS_AGE_S:
                self.runs.mkdir(parents=True, exist_ok=True)
                output = await self._call(["runs", f"--folder={self.runs}", "--json"])
                try:
                    runs = msgspec.json.decode(output)
                except msgspec.DecodeError:
                    raise JobError(f"the runs in {self.runs} could not be listed") from None
                self._list = (time.monotonic(), runs)
            return runs

    async def plot(self, name: str) -> bytes:
        """Return the picture of a recording, or of an experiment; raise `JobError`."""
        if not _RUN_NAME.fullmatch(name):
            raise JobError(f"'{text.quoted(name)}' is not the name of a run")
        experiment = self.runs / name
        if experiment.is_dir():
            picture = next(experiment.glob("*.png"), None)
            if picture is None:
                raise JobError(f"{name} has no picture: one is drawn at the end of an experiment")
            return await asyncio.to_thread(picture.read_bytes)
        if self._waiting_plots >= MAX_WAITING_PLOTS:
            raise JobError("too many pictures are being drawn; try again later")
        self._waiting_plots += 1
        try:
            async with self._plotting:
                picture = Path(self._cache.name, f"{name}.png")
                if not _is_newer(picture, experiment.with_name(f"{name}.mcap")):
                    where = (f"--folder={self.runs}", f"--to={self._cache.name}")
                    await self._call(["plot", name, "--png", "--force", *where, "--json"])
                return await asyncio.to_thread(picture.read_bytes)
        except FileNotFoundError:
            raise JobError(f"{name} could not be drawn") from None
        finally:
            self._waiting_plots -= 1


def _is_newer(file: Path, other: Path) -> bool:
    try:
        return file.stat().st_mtime > other.stat().st_mtime
    except OSError:
        return False


def _format_value(value: Any) -> str:
    """Return a value in the notation of fishctl."""
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


async def _read_all(stream: asyncio.StreamReader) -> bytes:
    """Return the output of a process, up to `MAX_OUTPUT_BYTES`."""
    parts, size = [], 0
    while chunk := await stream.read(2**16):
        if size < MAX_OUTPUT_BYTES:
            parts.append(chunk)
        size += len(chunk)
    return b"".join(parts)


def _read_columns(path: Path) -> dict[str, list[float | None]]:
    columns: dict[str, list[float | None]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            for name in _CURVE:
                if name in row:
                    value = row[name]
                    columns.setdefault(name, []).append(float(value) if value else None)
    return columns
