"""The runner of a queue: one experiment after another, each as its own process.

It pauses when a run fails, when the fish has a fault, when it is interrupted, and on request; then
what has not ended is the first of the queue, and the next start resumes it. It never starts by
itself.
"""

import os
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

from fishd.cli.output import echo, format_reason, format_time_of_day
from fishd.client import Fish
from fishd.core import files, text
from fishd.core.console import INTERRUPTED
from fishd.core.errors import ConfigError, FishError
from fishd.core.experiment_queue import MAX_PAST, Item, Outcome, Past, Queue, QueueError, QueueFile
from fishd.core.experiments import EXPERIMENT_PREFIX, PROGRESS_PREFIX
from fishd.core.process.fishctl_child import fishctl_command
from fishd.core.process.interruption import SIGNALS, handle_signals
from fishd.lab.experiment import Header, find_answer, read_header

_NEVER_RESUMED = (2, os.EX_CONFIG)
"""Exit statuses of a run that would fail in the same way if it was resumed."""
_INTERRUPTED = (INTERRUPTED, -signal.SIGTERM)
"""Exit statuses of a run that was interrupted, also while its process was starting."""
POLL_S = 0.25
"""Time between two looks for a request to pause at once [s]."""


class QueueRunner:
    """The runner of one queue; use it once, in the main thread."""

    def __init__(self, file: QueueFile, *, take: bool = False, quiet: bool = False) -> None:
        """
        take: take the fish from another experiment for the first run
        quiet: print no results on standard output
        """
        self._file, self._take, self._quiet = file, take, quiet
        self._is_stopped = self._is_requested = False
        self._last_line = ""

    def run(self) -> int:
        """Run the queue until it is empty or pauses; return the exit status.

        Raises `QueueError` where another process runs it, or where there is nothing to run.
        """
        with self._file.running():
            with self._file.changing() as queue:
                if not queue.items:
                    raise QueueError(
                        "the queue is empty; add an experiment, as in 'fishctl queue add measure "
                        "swing'"
                    )
                queue.reason, queue.pauses = "", False
                if queue.pause_at is not None and queue.pause_at <= time.time():
                    queue.pause_at = None
            # Later ones, too: the end of a program with threads sends its children several.
            with handle_signals(SIGNALS, self._stop):
                while item := self._begin_next():
                    if not self._finish(item, self._run(item)):
                        break
        queue = self._file.read()
        _print_line(
            f"fishctl: the queue {f'pauses: {queue.reason}' if queue.reason else 'is empty'}"
        )
        if self._is_stopped:
            return INTERRUPTED
        return 0 if not queue.reason or self._is_requested else 1

    def _stop(self, *_: object) -> None:
        """Interrupt the run that goes on, and pause."""
        self._is_stopped = True

    def _begin_next(self) -> Item | None:
        """Return the next item, marked as the one that runs; None if the queue pauses or ends."""
        problem = self._find_problem()
        with self._file.changing() as queue:
            if queue.items:
                requested = self._find_request(queue)
                self._is_requested = bool(requested)
                queue.reason = requested or problem
            if not queue.items or queue.reason:
                queue.pauses = False
                return None
            item = queue.items[0]
            name = f"{_verb(item)[-1]}-{time.strftime('%Y%m%d-%H%M%S')}"
            item.run = item.run or files.unused_path(self._file.runs, name, "").name
            queue.current, queue.began = item.id, time.time()
        return item

    def _find_request(self, queue: Queue) -> str:
        """Return the request for which a queue pauses before its next run; empty without one."""
        if self._is_stopped:
            return "it was stopped"
        if queue.pause_at is not None and queue.pause_at <= time.time():
            at, queue.pause_at = format_time_of_day(queue.pause_at), None
            return f"it was to stop at {at}"
        return "it was to pause after that run" if queue.pauses else ""

    def _find_problem(self) -> str:
        """Return why no run can begin now; empty if one can."""
        try:
            with Fish(self._file.address) as fish:
                status = fish.status()
        except FishError as error:
            return text.error_message(error)
        if status.mode in ("fault", "estop"):
            reason = format_reason(status.reason) if status.reason else status.mode
            return f"the fish is in mode {status.mode} ({reason}); then run 'fishctl clear-fault'"
        return ""

    def _run(self, item: Item) -> int:
        """Run an item once; return the exit status of its process."""
        folder = self._file.runs.absolute() / item.run
        header = _read_header(folder)
        place = [*_verb(item), "--resume"] if header else [*item.words, "--folder"]
        take = ["--take"] if self._take else []
        words = ["--endpoint", self._file.address, *place, str(folder), *take]
        self._take, self._last_line = False, ""
        _print_line(f"{EXPERIMENT_PREFIX.decode()}{item.id}: {' '.join(item.words)}")
        try:
            # Another session, as Ctrl-C in this terminal is for the runner.
            child = subprocess.Popen(
                fishctl_command(words),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL if self._quiet else None,
                stderr=subprocess.PIPE,
                cwd=item.cwd,
                start_new_session=True,
                encoding="utf-8",
                errors="replace",
            )
        except OSError as error:
            self._last_line = text.describe_error(error)
            return 1
        reader = threading.Thread(target=self._read_lines, args=(child,), daemon=True)
        reader.start()
        status = self._wait(child)
        reader.join()
        return status

    def _wait(self, child: "subprocess.Popen[str]") -> int:
        """Wait for the end of a run, and interrupt it when that is requested."""
        is_interrupted = False
        while True:
            with suppress(subprocess.TimeoutExpired):
                return child.wait(POLL_S)
            if not is_interrupted and self._is_interruption_due():
                is_interrupted = True
                child.terminate()

    def _is_interruption_due(self) -> bool:
        """Return whether the run that goes on is to be interrupted."""
        if self._is_stopped:
            return True
        with suppress(QueueError):  # a file that is damaged meanwhile interrupts nothing
            pause_at = self._file.read().pause_at
            return pause_at is not None and pause_at <= time.time()
        return False

    def _read_lines(self, child: "subprocess.Popen[str]") -> None:
        assert child.stderr
        with child.stderr as lines:
            for line in lines:
                if not line.startswith(PROGRESS_PREFIX.decode()):  # which is for a page
                    self._last_line = text.line(line).removeprefix("fishctl: ")
                _print_line(line.rstrip())

    def _finish(self, item: Item, status: int) -> bool:
        """Keep the outcome of a run; return whether the queue goes on."""
        folder = self._file.runs / item.run
        header = _read_header(folder)
        outcome: Outcome = "failed"
        message = self._last_line.partition("; resume with:")[0]
        if status == 0 or (header and header.ended):  # such as a budget that is used up
            outcome, message = "done", _describe_answer(folder, header)
        elif status in _INTERRUPTED and self._is_interruption_due():
            outcome = "stopped"
        with self._file.changing() as queue:
            kept = queue.find(item.id)
            queue.past.append(Past(item.words, item.run, time.time(), outcome, message))
            del queue.past[:-MAX_PAST]
            queue.current = None
            if outcome == "done":
                kept.repeat -= 1
            if outcome == "done" or header is None or status in _NEVER_RESUMED:
                kept.run = ""
            if not kept.repeat:
                queue.items.remove(kept)
            if outcome == "failed":
                queue.reason = f"experiment {item.id} failed: {message or f'status {status}'}"
        return outcome != "failed"


def _verb(item: Item) -> list[str]:
    """Return the verb of an item, such as `learn ppo`."""
    return item.words[: 2 if item.words[0] == "learn" else 1]


def _print_line(line: str) -> None:
    """Print a line; where the terminal is gone, the queue goes on without it."""
    with suppress(OSError):
        echo(line, err=True)


def _read_header(folder: Path) -> Header | None:
    """Return the header of an experiment that was begun; None where there is none."""
    try:
        return read_header(folder)
    except ConfigError:
        return None


def _describe_answer(folder: Path, header: Header | None) -> str:
    """Return the result of an experiment in a few words; empty where it has none."""
    answer = find_answer(folder)
    if answer.summary or answer.thrust is None:
        return answer.summary
    half = answer.thrust_ci95 if answer.total_ci95 is None else answer.total_ci95
    return text.format_measured(answer.thrust, half, header.force_unit if header else "N")
