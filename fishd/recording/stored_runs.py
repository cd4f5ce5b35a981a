"""Stored runs: their names and notes, the trash in which they stay for 30 days, and zip files."""

import errno
import os
import re
import shutil
import stat
import time
import zipfile
from calendar import timegm
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import IO

from msgspec import Struct

from fishd.core import files, text
from fishd.core.errors import RecordingError
from fishd.core.process.lockfile import find_lock_holder
from fishd.recording.folder import EXPERIMENT, LATEST, run_name
from fishd.recording.notes import MAX_NOTE_CHARACTERS, NOTE, note_path
from fishd.recording.part_file import PART_SUFFIX, SUFFIX, is_being_written, rename_to_final

TRASH = ".trash"
"""Folder of deleted runs, in the folder of runs; each is in a folder named after its time."""
KEPT_DAYS = 30
"""Time for which a deleted run stays in the trash [days]."""
PACKED_SUFFIXES = (SUFFIX, ".png", ".parquet", ".onnx", ".zip")
"""Endings of files that are compressed already."""
_NAME = re.compile(r"(?!latest$|.*\.(part|json|txt|lock|runner)$)\w[\w. -]{0,99}(?<! )")
"""Names of runs, which are neither another word for a run nor those of other files there."""
_ID, _ID_FORMAT = re.compile(r"\d{8}-\d{6}(-\d+)?", re.A), "%Y%m%d-%H%M%S"
_REMOVED = "removed-"
"""Beginning of the name of a deleted run's folder while it is removed."""
_READ_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


class DeletedRun(Struct):
    """A run in the trash."""

    id: str
    """Name of its folder there: UTC date and time of the deletion."""
    name: str
    deleted: float
    """Time of the deletion [s, unix]."""
    path: str


def find_stored_run(run: str, folder: Path) -> Path:
    """Return the folder of an experiment, or the file of a recording; raise `RecordingError`.

    run: its name, or the name of its file or folder, but no path
    """
    if "/" in run or run.startswith(".") or not run.isprintable():
        raise RecordingError(f"'{text.quoted(run)}' is not the name of a run in {folder}")
    for name in (run, run + SUFFIX, run + SUFFIX + PART_SUFFIX):
        try:
            mode = (folder / name).lstat().st_mode
        except OSError:
            continue
        if stat.S_ISLNK(mode):
            raise RecordingError(f"{folder / name} is a symbolic link; change what it leads to")
        is_recording = name.endswith((SUFFIX, SUFFIX + PART_SUFFIX)) and stat.S_ISREG(mode)
        if is_recording or (folder / name / EXPERIMENT).is_file():
            return folder / name
    raise RecordingError(f"no run is named '{text.quoted(run)}' in {folder}; see 'fishctl runs'")


def set_note(path: Path, note: str) -> None:
    """Replace the note of a run; raise `RecordingError`. The recording itself stays unchanged."""
    if len(note) > MAX_NOTE_CHARACTERS or not note.isprintable():
        raise RecordingError(f"a note is one line of at most {MAX_NOTE_CHARACTERS} characters")
    with _os_errors(note_path(path), "cannot be written"):
        files.write_atomically(note_path(path), f"{note}\n")


def rename_run(path: Path, name: str) -> Path:
    """Rename a run, never onto another one; return its new path; raise `RecordingError`."""
    name, old = name.removesuffix(SUFFIX), _name_of(path)
    if not _NAME.fullmatch(name):
        raise RecordingError(
            f"'{text.quoted(name)}' cannot be a name: letters, digits, '_', '-', '.' and spaces, "
            "at most 100, the first one a letter, a digit or '_', the last one no space; neither "
            f"'{LATEST}' nor a file's, such as queue.json"
        )
    _refuse_in_progress(path)
    target = path.with_name(name + path.name.removeprefix(old))
    _refuse_taken(path.parent, name)
    _move(path, target)
    return target


def delete_run(path: Path) -> DeletedRun:
    """Move a run into the trash, and remove older ones from it; raise `RecordingError`."""
    _refuse_in_progress(path)
    trash = path.parent / TRASH
    with _os_errors(trash, "cannot take it; 'fishctl runs trash --empty' makes room"):
        trash.mkdir(exist_ok=True)
        if trash.is_symlink():
            raise OSError(errno.ELOOP, "it is a symbolic link", str(trash))
        while True:
            place = files.unused_path(trash, time.strftime(_ID_FORMAT, time.gmtime()), "")
            with suppress(FileExistsError):  # another process deletes a run, too
                place.mkdir()
                break
    try:
        _move(path, place / path.name)
    except RecordingError:
        place.rmdir()
        raise
    with suppress(RecordingError):
        empty_trash(path.parent, KEPT_DAYS)
    return DeletedRun(place.name, _name_of(path), _deletion_time(place), str(place / path.name))


def list_trash(folder: Path) -> list[DeletedRun]:
    """Return the deleted runs of a folder, the latest first; raise `RecordingError`."""
    deleted = []
    for place in sorted(_list_places(folder), reverse=True):
        paths = list[Path]()
        with _os_errors(place, "cannot be read"), suppress(FileNotFoundError):
            paths = sorted(place.iterdir())
        for path in paths:
            if path not in map(note_path, paths):
                time_s = _deletion_time(place)
                deleted.append(DeletedRun(place.name, _name_of(path), time_s, str(path)))
    return deleted


def restore_run(deleted_id: str, folder: Path) -> Path:
    """Move a run back from the trash; return its path; raise `RecordingError`."""
    for deleted in list_trash(folder):
        if deleted_id in (deleted.id, deleted.name):  # the latest of several of one name
            _refuse_taken(folder, deleted.name, "rename that one first")
            path = Path(deleted.path)
            _move(path, folder / path.name)
            with suppress(OSError):
                path.parent.rmdir()
            return folder / path.name
    raise RecordingError(f"the trash has no '{text.quoted(deleted_id)}'; see 'fishctl runs trash'")


def empty_trash(folder: Path, days: float = 0.0, ids: Collection[str] = ()) -> int:
    """Remove what has been in the trash for longer than this time; return the number of runs.

    ids: the only runs to remove; all by default
    Raise `RecordingError` for a run that cannot be removed, after the others are.
    """
    runs, problem = 0, None
    for place in list(_list_places(folder, is_removal=True)):
        is_meant = not ids or place.name.removeprefix(_REMOVED) in ids
        if not is_meant or time.time() - _deletion_time(place) < days * 86400:
            continue
        try:
            with _os_errors(place, "cannot be removed"), suppress(FileNotFoundError):
                removed = place
                if not place.name.startswith(_REMOVED):  # no part of it can be restored
                    removed = place.rename(place.with_name(_REMOVED + place.name))
                shutil.rmtree(removed)
                runs += 1
        except RecordingError as error:
            problem = problem or error
    if problem:
        raise problem
    return runs


def pack_run(path: Path, stream: IO[bytes]) -> None:
    """Write the files of a run as a zip file into a stream, with little memory; raise OSError.

    Links, pipes and locks are left out. Raise `RecordingError` if the run is removed meanwhile.
    """
    name, is_folder = _name_of(path), path.is_dir()
    place = os.open(path if is_folder else path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with zipfile.ZipFile(stream, "w", strict_timestamps=False) as archive:
            if not is_folder:
                for file in (path.name, note_path(path).name):
                    _pack_file(archive, file, place, name)
                return
            for root, _, names, folder in os.fwalk(".", dir_fd=place):
                for file in sorted(names):
                    _pack_file(archive, file, folder, str(Path(name, root)))
            if not os.access(EXPERIMENT, os.F_OK, dir_fd=place):
                raise RecordingError(f"{name} was removed before all of it was packed")
    finally:
        os.close(place)


def _pack_file(archive: zipfile.ZipFile, name: str, folder: int, place: str) -> None:
    """Add a file to an archive, unless it is none.

    folder: descriptor of its folder; place: path of that folder in the archive
    """
    try:
        descriptor = os.open(name, _READ_FLAGS, dir_fd=folder)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO, errno.ENOENT):  # a link, a socket, or removed
            return
        raise
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or name.endswith(".lock"):
            return
        date = max(time.localtime(status.st_mtime)[:6], (1980, 1, 1, 0, 0, 0))
        entry = zipfile.ZipInfo(f"{place}/{name}".encode(errors="replace").decode(), date)
        if not name.endswith(PACKED_SUFFIXES):
            entry.compress_type = zipfile.ZIP_DEFLATED
        with archive.open(entry, "w", force_zip64=True) as packed:
            shutil.copyfileobj(file, packed)


def _name_of(path: Path) -> str:
    return path.name if path.is_dir() else run_name(path)


def _refuse_in_progress(path: Path) -> None:
    """Raise `RecordingError` if a process records or measures it."""
    locks = [lock.with_suffix("") for lock in path.glob("*.lock")] if path.is_dir() else []
    parts = [*path.glob(f"*{PART_SUFFIX}")] if path.is_dir() else [path]
    if any(map(find_lock_holder, locks)) or any(map(is_being_written, parts)):
        raise RecordingError(f"{_name_of(path)} is in progress; stop it, or wait for its end")


def _refuse_taken(folder: Path, name: str, remedy: str = "choose another name") -> None:
    for suffix in ("", SUFFIX, SUFFIX + PART_SUFFIX, f".{NOTE}"):  # a note of a run that is gone
        if os.path.lexists(folder / f"{name}{suffix}"):
            raise RecordingError(f"{folder / f'{name}{suffix}'} exists already; {remedy}")


def _move(path: Path, target: Path) -> None:
    """Move a run with its note; raise `RecordingError`, and then change nothing."""
    note, new_note = note_path(path), note_path(target)
    with _os_errors(path, "cannot be moved"):
        if path.is_dir():
            path.rename(target)
            return
        rename_to_final(path, target)
    with _os_errors(note, "cannot be moved"), suppress(FileNotFoundError):
        note.rename(new_note)


def _list_places(folder: Path, *, is_removal: bool = False) -> Iterator[Path]:
    """Yield the folder of each deleted run; for a removal also what is left of an earlier one."""
    trash = folder / TRASH
    with _os_errors(trash, "cannot be read"), suppress(FileNotFoundError):
        if not trash.is_symlink():
            for path in trash.iterdir():
                name = path.name.removeprefix(_REMOVED) if is_removal else path.name
                if _ID.fullmatch(name):
                    yield path


def _deletion_time(place: Path) -> float:
    """Return the time in the name of the folder of a deleted run [s, unix]."""
    try:
        return timegm(time.strptime(place.name.removeprefix(_REMOVED)[:15], _ID_FORMAT))
    except ValueError:
        return 0.0


def _os_errors(path: Path, problem: str) -> AbstractContextManager[None]:
    return files.os_errors(RecordingError, f"{path} {problem}")
