"""The folder of recordings: where it is, what is in it, and which recording a name means."""

import os
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from fishd.core import files
from fishd.core.errors import RecordingError
from fishd.core.schema import suggest
from fishd.recording.mcap_file import metadata
from fishd.recording.part_file import PART, SUFFIX, is_being_written
from fishd.recording.reader import open_run
from fishd.recording.summary import Summary, from_metadata

FOLDER_VARIABLE = "FISHD_RUNS"
LATEST = "latest"
"""Stands for the newest recording."""


class Glance(NamedTuple):
    """A recording in short."""

    name: str
    path: Path
    about: dict[str, str]
    """As `Run.about`."""
    summary: Summary
    finished: bool
    writing: bool
    """True while some process still writes it."""
    damaged: int | None = None
    """How many ticks cannot be read; None where nothing is damaged."""


def runs_folder() -> Path:
    """Return the folder of recordings and experiments; it need not exist.

    $FISHD_RUNS, else the state folder of a service, else `runs` in the current folder.
    """
    given = (
        os.environ.get(FOLDER_VARIABLE) or os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    )
    return Path(given or "runs")


def made(folder: Path) -> Path:
    """The folder, once it is there; raises `RecordingError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{folder} cannot be made: {error.strerror}") from None
    return folder


def check_new(paths: Iterable[Path], *, replace: bool) -> None:
    """Raise `RecordingError` where one of these is there already, unless it may be replaced."""
    for path in paths:
        if path.exists() and not replace:
            raise RecordingError(f"{path} is there already; --force replaces it")


def new_path(folder: Path, prefix: str = "") -> Path:
    """A path for a recording that begins now, named after the date and time of this place."""
    name = f"{prefix}{datetime.now():%Y-%m-%d-%H%M%S}"
    path, number = folder / (name + SUFFIX), 1
    while os.path.lexists(path) or os.path.lexists(f"{path}{PART}"):
        number += 1
        path = folder / f"{name}-{number}{SUFFIX}"
    return path


def named(run: str, folder: Path | None = None) -> Path:
    """The path of a new recording: as given where it has a `/`, else in the folder of recordings.

    `.mcap` is added where it is missing, and that folder is made; raises `RecordingError`.
    """
    if Path(run).name in ("", ".."):  # "/", "." and their like
        raise RecordingError(f"'{run}' is no name of a recording")
    path = files.expand_user(run) if "/" in run else made(folder or runs_folder()) / run
    return path.with_name(path.name.removesuffix(SUFFIX) + SUFFIX)


def paths(folder: Path) -> list[Path]:
    """All recordings of a folder, finished or not, the oldest first."""
    try:
        ending = (path for path in folder.iterdir() if path.name.endswith((SUFFIX, SUFFIX + PART)))
        found = [path for path in ending if path.is_file()]  # a pipe would never be read to its end
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError(f"{folder} cannot be read: {error.strerror}") from None
    return [path for _, path in sorted((_modified(path), path) for path in found)]


def find(run: str, folder: Path | None = None) -> Path:
    """The file that a name means: a path, a name in the folder of recordings, or `latest`.

    Raises `RecordingError`.
    """
    path = files.expand_user(run)
    if path.is_file():
        return path
    folder = folder or runs_folder()
    known = paths(folder)
    if run == LATEST:
        if not known:
            raise RecordingError(f"there is no recording in {folder} yet; see 'fishctl record'")
        return known[-1]
    for suffix in ("", SUFFIX, SUFFIX + PART):
        if "/" not in run and (found := folder / (run + suffix)).is_file():
            return found
    names = [name_of(path) for path in known]
    hint = suggest(run, names[-10:], listed="there are") if names else "there is none yet"
    raise RecordingError(f"no recording '{run}', neither a file nor a name in {folder}; {hint}")


def name_of(path: Path) -> str:
    """The name of a recording, without suffix."""
    return path.name.removesuffix(PART).removesuffix(SUFFIX)


def glances(folder: Path) -> Iterator[Glance | RecordingError]:
    """All recordings of a folder in short, the oldest first; or what is wrong with one."""
    for path in paths(folder):
        try:
            yield glance(path)
        except RecordingError as error:
            yield error


def glance(path: Path) -> Glance:
    """A recording in short; soon where it is finished and whole. Raises `RecordingError`."""
    said = metadata(path) or {}
    summary = from_metadata(said.get("fishd.end", {}))
    if summary is not None and "fishd.run" in said:
        return Glance(name_of(path), path, said["fishd.run"], summary, True, False)
    run = open_run(path)
    writing = is_being_written(path)
    damaged = run.damaged if run.is_damaged else None
    return Glance(run.name, path, run.about, run.summary, run.finished, writing, damaged)


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0
