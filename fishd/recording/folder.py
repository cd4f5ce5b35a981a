"""The folder of recordings: its place, its content, and the recordings that names refer to."""

import os
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from fishd.core import files, text
from fishd.core.errors import RecordingError
from fishd.core.schema import suggest
from fishd.recording.numbering import list_files, read_number
from fishd.recording.part_file import PART_SUFFIX, SUFFIX, is_being_written
from fishd.recording.reader import find_repaired_problem, open_run
from fishd.recording.summary import Summary
from fishd.recording.writer import RunWriter

FOLDER_VARIABLE = "FISHD_RUNS"
EXPERIMENT = "experiment.json"
"""File with the header of an experiment, in its folder."""
MAX_LISTED = 3
"""Largest number of recordings of an experiment that a message lists."""
LATEST = "latest"
"""Name that refers to the recording with the largest number, the newest one."""


class Overview(NamedTuple):
    """Overview of a recording."""

    name: str
    path: Path
    about: dict[str, str]
    """Metadata, as in `Run.about`."""
    summary: Summary
    finished: bool
    writing: bool
    """True while a process writes it."""
    problem: str = ""
    """Difference between the file and what was recorded, as in `Run.problem`."""
    recorded_ticks: int | None = None
    """Number of ticks when the recording ended; None if unknown."""


def runs_folder() -> Path:
    """Return the folder of recordings and experiments; it need not exist.

    $FISHD_RUNS, else the state folder of a service, else `runs` in the current folder.
    """
    configured = (
        os.environ.get(FOLDER_VARIABLE) or os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    )
    return Path(configured or "runs")


def ensure_folder(folder: Path) -> Path:
    """Create the folder if it does not exist, and return it; raise `RecordingError`."""
    with files.os_errors(RecordingError, f"{folder} cannot be created"):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def check_new_files(paths: Iterable[Path], *, replace: bool) -> None:
    """Raise `RecordingError` if one of these exists, unless it may be replaced."""
    for path in paths:
        if path.exists() and not replace:
            raise RecordingError(f"{path} already exists; use --force to replace it")


def open_new(folder: Path, open_writer: Callable[[Path], RunWriter], prefix: str = "") -> RunWriter:
    """Begin a recording with an unused name, also if another process begins one in this moment.

    open_writer: begins a recording with this path
    """
    while True:
        path = new_path(folder, prefix)
        try:
            return open_writer(path)
        except RecordingError:
            if not (path.exists() or path.with_name(path.name + PART_SUFFIX).exists()):
                raise


def new_path(folder: Path, prefix: str = "") -> Path:
    """Return a path for a recording that begins now, named after the local date and time."""
    name = f"{prefix}{datetime.now():%Y-%m-%d-%H%M%S}"
    return files.unused_path(folder, name, SUFFIX, SUFFIX + PART_SUFFIX)


def recording_path(run: str, folder: Path | None = None) -> Path:
    """Return the path of a new recording: as given if it has a `/`, else in the runs folder.

    Add `.mcap` if it is missing, and create that folder; raise `RecordingError`.
    """
    name = Path(run).name
    if name in ("", "..") or any(ord(letter) < 32 for letter in name):  # such as "/" or "."
        raise RecordingError(f"'{text.escaped(run)}' is not a valid name of a recording")
    path = files.expand_user(run) if "/" in run else ensure_folder(folder or runs_folder()) / run
    return path.with_name(path.name.removesuffix(SUFFIX) + SUFFIX)


def list_recordings(folder: Path, prefix: str = "") -> list[Path]:
    """Return all recordings of a folder, finished or not, in the order of their numbers.

    Older recordings without a number, and those whose beginning is damaged, come first, by name.

    prefix: beginning of their names
    """
    paths = list_files(folder, prefix)
    return sorted(paths, key=lambda path: (read_number(path), run_name(path), path.name))


def find_recording(run: str, folder: Path | None = None) -> Path:
    """Return the file of a path, of a name in the folder of recordings, or of `latest`.

    Raise `RecordingError`.
    """
    path = files.expand_user(run)
    if path.is_file():
        return path
    folder = folder or runs_folder()
    known = list_recordings(folder)
    if run == LATEST:
        if not known:
            raise RecordingError(f"{folder} contains no recording; make one with 'fishctl record'")
        return known[-1]
    base = path if "/" in run else folder / run
    for suffix in ("", SUFFIX, SUFFIX + PART_SUFFIX):
        if (candidate := Path(f"{base}{suffix}")).is_file():
            return candidate
    if (base / EXPERIMENT).is_file():
        raise RecordingError(f"{base} is an experiment, not a recording; {_list_content(base)}")
    names = [run_name(path) for path in known]
    hint = (
        suggest(run, names[-10:], listed="recordings there")
        if names
        else "that folder contains none"
    )
    raise RecordingError(f"no recording '{run}', neither a file nor a name in {folder}; {hint}")


def _list_content(experiment: Path) -> str:
    """Return in words the recordings and pictures in the folder of an experiment."""
    lists = []
    for kind, pattern in (("recordings", f"*{SUFFIX}"), ("pictures", "*.png")):
        names = [str(path) for path in sorted(experiment.rglob(pattern))]
        more = f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
        lists.append(f"{kind}: {', '.join(names[:MAX_LISTED]) or 'none'}{more}")
    return "; ".join(lists)


def run_name(path: Path) -> str:
    """Return the name of a recording, without suffix."""
    return path.name.removesuffix(PART_SUFFIX).removesuffix(SUFFIX)


def read_overviews(folder: Path) -> Iterator[Overview | RecordingError]:
    """Yield an overview of each recording of a folder, the oldest first, or its error."""
    for path in list_recordings(folder):
        try:
            yield read_overview(path)
        except RecordingError as error:
            yield error


def read_overview(path: Path) -> Overview:
    """Return an overview of a recording, quickly if it is finished and nothing of it is missing.

    Raise `RecordingError`.
    """
    run = open_run(path, with_messages=False)
    summary = run.stated_summary
    if summary is not None:
        problem, is_writing = find_repaired_problem(run.reason), False
    else:
        run = open_run(path)
        summary, problem, is_writing = run.summary, run.problem, is_being_written(path)
    return Overview(
        run.name, path, run.about, summary, run.finished, is_writing, problem, run.recorded_ticks
    )
