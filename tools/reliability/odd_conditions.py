"""Trials of fishctl and fishd under odd conditions: full disk, few file descriptors, closed output.

Each command either does its work, or says in one line why not, with the matching exit status; an
emergency stop works under every condition. A condition that needs a file system mounts it in a
mount namespace that ends with the command; where that is not permitted, the cell says so.
"""

import os
import shutil
import signal
import subprocess
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct

from common.daemon import Fishd
from common.processes import FISHCTL, FISHD
from common.report import Options, Report, progress, table
from fishd.client import Fish, FishError

TIMEOUT_S = 90.0
"""Time after which a command counts as hung [s]."""
START_S = 30.0
"""Longest time until fishd answers, or is terminated [s]."""

Done = subprocess.CompletedProcess[str] | subprocess.TimeoutExpired
"""Result of a command: its end, or that it hung."""

OPTIONS: Options = {
    "--only": {"nargs": "+", "metavar": "CONDITION", "help": "of all conditions"},
    "--groups": {"nargs": "+", "metavar": "GROUP", "help": "of all groups of verbs"},
}


class Condition(NamedTuple):
    """Odd condition, as the beginning of a shell script in the folder of the trial."""

    setup: str
    """Commands that cause the condition; `$FOLDER` is the folder for the command's files."""
    redirect: str = ""
    """Redirection of the command."""
    environment: tuple[tuple[str, str | None], ...] = ()
    """Variables to set, or to remove."""
    mounts: bool = False
    """Whether it mounts a file system."""
    keeps_from_writing: bool = False
    """Whether a command that writes files may fail."""
    loses_output: bool = False
    """Whether standard output cannot be written."""


_CONFIG = Path(__file__).resolve().parents[2] / "config/simulated.yaml"
_MOUNTED = 'mountpoint -q "$FOLDER" || exit 125; cd "$FOLDER"'
CONDITIONS = {
    "as usual": Condition(""),
    "locale C": Condition(
        "",
        environment=(("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONCOERCECLOCALE", "0")),
    ),
    "closed stdout": Condition("", redirect=">&-", loses_output=True),
    "full stdout": Condition("", redirect=">/dev/full", loses_output=True),
    "deleted folder": Condition(
        'mkdir "$FOLDER/gone"; cd "$FOLDER/gone"; rmdir "$FOLDER/gone"', keeps_from_writing=True
    ),
    "no HOME": Condition(
        "", environment=(("HOME", None), ("XDG_DATA_HOME", None), ("XDG_STATE_HOME", None))
    ),
    "64 files": Condition("ulimit -n 64"),
    "512 MB": Condition("ulimit -v 524288"),
    "files of 8 kB": Condition("ulimit -f 16", keeps_from_writing=True),
    "no /dev/shm": Condition("mount -t tmpfs -o ro none /dev/shm || exit 125", mounts=True),
    "read-only folder": Condition(
        f'mount -t tmpfs -o ro none "$FOLDER" || exit 125; {_MOUNTED}',
        mounts=True,
        keeps_from_writing=True,
    ),
    "full disk": Condition(
        f'mount -t tmpfs -o size=64k none "$FOLDER" || exit 125; {_MOUNTED}',
        mounts=True,
        keeps_from_writing=True,
    ),
}
_NOT_TRIED = 125
"""Exit status where a file system cannot be mounted."""


class Verb(NamedTuple):
    """One command of a group of verbs."""

    words: str
    """Words of its command line; `FOLDER` is its folder for files, `RUN` an existing recording."""
    statuses: tuple[int, ...] = (0,)
    """Exit statuses without an odd condition."""
    writes: bool = False
    """Whether it writes into a folder, and may fail where that is not possible."""
    is_heavy: bool = False
    """Whether it starts processes or loads large libraries, and may fail without resources."""
    after: Callable[[Fish], bool] | None = None
    """Condition that the fish must meet afterwards, for any exit status."""


def _is_stopped(fish: Fish) -> bool:
    return fish.status().mode == "estop"


VERBS = {
    "look": [Verb("--version"), Verb("status"), Verb("status --json"), Verb("controllers")],
    "config": [Verb("config show"), Verb("config check CONFIG")],
    "swim": [Verb("set-controller square --frequency 1"), Verb("mark fin-é"), Verb("stop")],
    "estop": [Verb("estop", after=_is_stopped)],
    "doctor": [Verb("doctor --set control.address=CONTROL --set telemetry.address=TELEMETRY")],
    "camera": [Verb("camera status", statuses=(1,))],
    "simulate": [Verb("simulate square --seconds 20")],
    "record": [
        Verb("record --for 2 --folder FOLDER", writes=True),
        Verb("runs --folder RUNS"),
        Verb("export RUN --csv --to FOLDER", writes=True, is_heavy=True),
        Verb("plot RUN --to FOLDER", writes=True, is_heavy=True),
    ],
    "sweep": [
        Verb(
            "sweep square --frequency 1,2 --periods 2 --settle 1 --jobs 2 --folder FOLDER/sweep",
            writes=True,
            is_heavy=True,
        )
    ],
}


class Cell(Struct, frozen=True):
    """One command under one condition."""

    group: str
    condition: str
    command: str
    status: int | None
    """Exit status; None where it hung, below 0 where a signal ended it."""
    said: str
    """Standard error."""
    wrong: str
    """Mistake in its result; empty without one."""
    tried: bool = True


def measure(options: Namespace) -> Report:
    """Try every command under every condition."""
    cells = []
    conditions = options.only or list(CONDITIONS)
    groups = options.groups or [*VERBS, "fishd"]
    with Fishd("realtime.priority=0") as fishd, _workplace(fishd) as place:
        for condition in conditions:
            for group in groups:
                row = list(try_group(group, condition, fishd, place))
                cells += row
                progress(condition, group, "; ".join(_describe(cell) for cell in row))
    return Report(
        {"reliability odd_conditions": _table(cells, conditions, groups)},
        cells,
        broken=any(cell.wrong for cell in cells),
        number=f"{sum(bool(cell.wrong) for cell in cells)} of "
        f"{sum(cell.tried for cell in cells)} commands not right, "
        f"under {len(conditions)} conditions",
    )


class Place(NamedTuple):
    """Folders of a trial."""

    folder: Path
    """Folder that the commands write into, empty before each."""
    runs: Path
    """Folder of existing recordings."""
    run: Path


@contextmanager
def _workplace(fishd: Fishd) -> Iterator[Place]:
    with tempfile.TemporaryDirectory(prefix="fishd-odd-") as name:
        runs = Path(name) / "runs"
        fishd.next_tick()
        command = [FISHCTL, "record", "before", "--for", "4", "--folder", runs]
        subprocess.run(command, env=_environment(fishd), check=True, capture_output=True)
        yield Place(Path(name) / "folder", runs, next(runs.glob("*.mcap")))


def try_group(group: str, name: str, fishd: Fishd, place: Place) -> Iterator[Cell]:
    """Run each command of a group under a condition, on a fish that swims before each."""
    if group == "fishd":
        yield _try_fishd(name, place)
        return
    for verb in VERBS[group]:
        with Fish(fishd.endpoint, timeout=TIMEOUT_S) as fish:
            fish.clear_fault()
            fish.set_controller("swing")
            done = _run(verb, name, fishd, place)
            wrong = _judge(verb, CONDITIONS[name], name, done)
            if not wrong and verb.after and done.returncode != _NOT_TRIED and not verb.after(fish):
                wrong = "the fish is not in the state that was asked for"
        yield _cell(group, name, verb.words, done, wrong)


def _run(verb: Verb, name: str, fishd: Fishd, place: Place) -> Done:
    words = [
        word.replace("FOLDER", str(place.folder))
        .replace("RUNS", str(place.runs))
        .replace("RUN", str(place.run))
        .replace("CONFIG", str(_CONFIG))
        .replace("CONTROL", fishd.endpoint)
        .replace("TELEMETRY", fishd.telemetry)
        for word in verb.words.split()
    ]
    return _under(name, [FISHCTL, *words], _environment(fishd), place)


def _under(name: str, command: list[str], environment: dict[str, str], place: Place) -> Done:
    condition = CONDITIONS[name]
    shutil.rmtree(place.folder, ignore_errors=True)
    place.folder.mkdir()
    script = f'{condition.setup or ":"}; exec "$@" {condition.redirect}'
    shell = ["sh", "-c", script, "sh", *command]
    if condition.mounts:
        shell = ["unshare", "--mount", *shell]
    variables = environment | {"FOLDER": str(place.folder)}
    for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # few users set these
        variables.pop(key, None)
    for key, value in condition.environment:
        if value is None:
            variables.pop(key, None)
        else:
            variables[key] = value
    process = subprocess.Popen(
        shell,
        env=variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    if command[0] == FISHD:
        _wait_for_answer(process, place)
        process.terminate()
    try:
        out, said = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired as hung:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return hung
    texts = (text.decode("utf-8", "replace") for text in (out, said))
    return subprocess.CompletedProcess(command, process.returncode, *texts)


def _wait_for_answer(process: "subprocess.Popen[bytes]", place: Place) -> None:
    """Wait until fishd answers or ends."""
    deadline = time.monotonic() + START_S
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(FishError), Fish(_control(place), timeout=1.0) as fish:
            fish.status()
            return
        time.sleep(0.05)


def _control(place: Place) -> str:
    return f"ipc://{place.runs.parent}/control"


def _environment(fishd: Fishd) -> dict[str, str]:
    return {**os.environ, "FISHD_ENDPOINT": fishd.endpoint, "FISHD_CONFIG": ""}


def _try_fishd(name: str, place: Place) -> Cell:
    """Start fishd under a condition, and end it; it may refuse to start, in one line."""
    words = ["--no-print-status", "--set", f"control.address={_control(place)}"]
    words += ["--set", f"telemetry.address=ipc://{place.runs.parent}/telemetry"]
    words += ["--set", "start.controller=swing"]
    words += ["--set", "realtime.priority=0", "--set", "realtime.lock_memory=false"]
    environment = {**os.environ, "FISHD_CONFIG": ""}
    done = _under(name, [FISHD, *words], environment, place)
    wrong = _common_fault(done)
    if not wrong and not isinstance(done, subprocess.TimeoutExpired):
        if done.returncode == 0 and "stopping" not in done.stderr:
            wrong = "it did not swim"
        elif done.returncode not in (0, 1, _NOT_TRIED):
            wrong = f"exit status {done.returncode}"
    return _cell("fishd", name, "fishd", done, wrong)


def _common_fault(done: Done) -> str:
    if isinstance(done, subprocess.TimeoutExpired):
        return f"hangs for {TIMEOUT_S:g} s"
    if done.returncode == _NOT_TRIED:
        return ""
    if done.returncode < 0:
        return f"ended by {signal.Signals(-done.returncode).name}"
    for word in ("Traceback", "Exception ignored", "Fatal Python error", "Assertion failed"):
        if word in done.stderr:
            return word
    return ""


def _judge(verb: Verb, condition: Condition, name: str, done: Done) -> str:
    """Return the mistake in the end of a command; empty without one."""
    fault = _common_fault(done)
    if fault or isinstance(done, subprocess.TimeoutExpired) or done.returncode == _NOT_TRIED:
        return fault
    lines = done.stderr.splitlines()
    cannot_write = verb.writes and condition.keeps_from_writing
    falls_short = verb.is_heavy and name in ("512 MB", "no /dev/shm")
    permitted = set(verb.statuses)
    if condition.loses_output and verb.after is None:
        permitted = {1}
    elif cannot_write or falls_short or name in ("64 files", "no HOME"):
        permitted.add(1)
    if done.returncode not in permitted:
        return f"exit status {done.returncode}"
    failed = done.returncode not in verb.statuses or verb.statuses == (1,)
    if failed and len(lines) != 1:
        return f"{len(lines)} lines of errors"
    if condition.loses_output and not lines:
        return "nothing is said about the output"
    return ""


def _cell(group: str, condition: str, words: str, done: Done, wrong: str) -> Cell:
    if isinstance(done, subprocess.TimeoutExpired):
        return Cell(group, condition, words, None, "", wrong)
    tried = done.returncode != _NOT_TRIED
    return Cell(group, condition, words, done.returncode, done.stderr.strip(), wrong, tried)


def _describe(cell: Cell) -> str:
    """Return one command's result: its exit status, or its mistake."""
    if not cell.tried:
        return "not tried"
    if cell.wrong:
        return f"`{cell.command}`: {cell.wrong}: {cell.said[-300:]}"
    return str(cell.status)


def _table(cells: list[Cell], conditions: list[str], groups: list[str]) -> str:
    rows = []
    for condition in conditions:
        row = [condition]
        for group in groups:
            matches = [cell for cell in cells if (cell.group, cell.condition) == (group, condition)]
            row.append(_summary(matches))
        rows.append(row)
    tried = sum(cell.tried for cell in cells)
    wrong = sum(bool(cell.wrong) for cell in cells)
    return (
        table(" | ".join(["condition", *groups]), rows)
        + f"\n\n{tried} commands, {wrong} of them with a result that is not right, "
        f"in {time.strftime('%Y-%m')}. `ok`: each did its work, with status 0; `line`: one or more "
        "said in one line why not, with status 1; `–`: no file system could be mounted."
    )


def _summary(cells: list[Cell]) -> str:
    if any(cell.wrong for cell in cells):
        return "**wrong**"
    if not any(cell.tried for cell in cells):
        return "–"
    return "line" if any(cell.status for cell in cells if cell.tried) else "ok"
