"""The folder of an experiment: a header, a table of rows, recordings, and what it can resume.

sweep, optimise and adapt keep all that they measure in such a folder; a training marks its folder
with the same header. Each file is written atomically, each row at once.
"""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import msgspec
from msgspec import Struct

from fishd import __version__
from fishd.core import files
from fishd.core.errors import ConfigError, FishdError
from fishd.core.files import FileProblem, write_atomically
from fishd.core.process.lockfile import NotALock, Taken, locked
from fishd.lab import tables
from fishd.lab.tables import Table
from fishd.recording.folder import runs_folder
from fishd.recording.part_file import PART, SUFFIX

HEADER, ROWS = "experiment.json", "rows.csv"
MAX_TABLE_BYTES = 256 * 2**20
"""Size of the longest table [bytes]: 2.6 kB for each of the points that a sweep may have."""
IRRELEVANT = ("control", "name", "panel", "realtime", "start", "state_folder", "telemetry")
"""Sections and keys of a configuration that have no part in the thrust."""
_NOT_COMPARED = ("began", "command", "version")

On = Literal["live", "simulation"]
T = TypeVar("T", bound=Struct)


class Progress(Protocol):
    """What a person sees of an experiment, as `fishd.cli.progress.Lines` is."""

    def done(self, line: str, amount: float) -> None:
        """Show what was done; amount: how much of the total is done by now."""

    def at(self, amount: float, found: str = "") -> None:
        """Show how much of the total is done by now, and what was found so far."""

    def warn(self, line: str) -> None:
        """Show a line on standard error."""


class Header(Struct, frozen=True, kw_only=True):
    """What all rows of an experiment have in common; a folder is resumed only with the same."""

    kind: str
    """Verb of the experiment, such as `sweep`."""
    on: On
    config: dict[str, Any] = {}
    """Configuration of the fish, as plain data."""
    settings: dict[str, Any] = {}
    """What else the rows depend on."""
    force_unit: str = "N"
    command: list[str] = []
    """Arguments of the verb, with which `--resume` begins."""
    began: str = ""
    """Local time of the start, in ISO 8601."""
    version: str = __version__


class Experiment:
    """A folder in which an experiment is kept as it is measured; see `open_experiment`."""

    def __init__(self, path: Path, header: Header) -> None:
        self.path = path
        self.header = header
        self._table: Table

    @property
    def resume_command(self) -> str:
        """Return the command line that resumes it."""
        return shlex.join(["fishctl", *self.header.kind.split(), "--resume", str(self.path)])

    def read_rows(self, columns: Sequence[str]) -> list[dict[str, str]]:
        """Return the rows that are there; a last row that a kill has cut off is dropped.

        columns: those of each row, in their order; the table is made where there is none
        Raises `ConfigError` where the table has other columns, and `FishdError`.
        """
        path, expected = self.path / ROWS, list(columns)
        rows: list[list[str]] = []
        if path.exists():
            try:
                head, *rows = tables.read(path, MAX_TABLE_BYTES)
            except (FileProblem, ValueError) as problem:
                raise ConfigError(f"{path}: {problem or 'it is empty'}; {_OTHER_FOLDER}") from None
            if head != expected:
                raise ConfigError(f"{path}: {_difference(head, expected)}; {_OTHER_FOLDER}")
            rows = [row for row in rows if len(row) == len(head)]
            whole = tables.lines([head, *rows])
            if path.read_bytes() != whole.encode():
                self.write(ROWS, whole)
        with self._writing():
            self._table = Table(path, expected)
        return [dict(zip(expected, row, strict=True)) for row in rows]

    def add_row(self, row: Mapping[str, Any]) -> None:
        """Add a row to the table, numbers in full precision; raises `FishdError`."""
        with self._writing():
            self._table.add(row)

    def write_rows(self, rows: Sequence[Mapping[str, str]]) -> None:
        """Replace the rows of the table; raises `FishdError`."""
        columns = self._table.columns
        self.write(
            ROWS, tables.lines([columns, *([row[each] for each in columns] for row in rows)])
        )

    def make_folder(self, name: str) -> Path:
        """Return a folder within that of the experiment; raises `FishdError`."""
        with self._writing():
            (self.path / name).mkdir(exist_ok=True)
        return self.path / name

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file of the folder; raises `FishdError`."""
        with self._writing():
            write_atomically(self.path / name, content)

    def read_struct(self, name: str, kind: type[T]) -> T | None:
        """Return what `write_struct` has written; None where it has not.

        Raises `ConfigError` where it is something else.
        """
        path = self.path / name
        return _read_struct(path, kind) if path.exists() else None

    def write_struct(self, name: str, value: Struct) -> None:
        """Write a struct as JSON; raises `FishdError`."""
        self.write(name, _as_json(value))

    def recording(self, stem: str) -> Path:
        """Return a free name for a recording; one that was broken off keeps its own."""
        number, path = 1, self.path / f"{stem}{SUFFIX}"
        while path.exists() or path.with_name(path.name + PART).exists():
            number += 1
            path = self.path / f"{stem}-{number}{SUFFIX}"
        return path

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Turn an OSError into `FishdError`."""
        try:
            yield
        except OSError as error:
            raise FishdError(
                f"{error.filename or self.path}: cannot be written: {error.strerror}; what was "
                "measured before is kept"
            ) from None


def default_folder(kind: str) -> Path:
    """Return a new name in the folder of all runs, from date and time."""
    return runs_folder() / f"{kind.split()[-1]}-{datetime.now():%Y%m%d-%H%M%S}"


@contextmanager
def open_experiment(path: Path, header: Header, *, resume: bool = False) -> Iterator[Experiment]:
    """Begin an experiment in a new folder, or resume one; no other process uses it meanwhile.

    resume: an experiment with the same header must be there
    Raises `ConfigError` where the folder is in use, of another experiment, or cannot be made.
    """
    if resume:
        _check_same(path, read_header(path), header)
    _make_folder(path)
    try:
        with locked(path / "experiment", remove=True):
            experiment = Experiment(path, header)
            if not resume:
                check_free(path)
                experiment.write_struct(HEADER, _dated(header))
            yield experiment
    except Taken as taken:
        raise ConfigError(f"{path}: another experiment uses it, process {taken.pid}") from None
    except NotALock as error:
        raise ConfigError(f"{error.filename}: {error.strerror}") from None


def mark_folder(path: Path, kind: str, on: On) -> None:
    """Make a new folder with a header, of an experiment that keeps the rest in files of its own.

    Raises `ConfigError` where it is not empty, or cannot be made, and OSError.
    """
    check_free(path)
    _make_folder(path)
    write_atomically(path / HEADER, _as_json(_dated(Header(kind=kind, on=on))))


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made a folder: {error.strerror}") from None


def _dated(header: Header) -> Header:
    """Return a header that begins now."""
    began = datetime.now().astimezone().isoformat(timespec="seconds")
    return msgspec.structs.replace(header, began=began)


def check_free(path: Path) -> None:
    """Raise `ConfigError` where a folder is there and not empty."""
    try:
        if path.exists() and any(not each.name.endswith(".lock") for each in path.iterdir()):
            how = f"--resume {path} goes on with it, " if (path / HEADER).exists() else ""
            raise ConfigError(f"{path}: the folder is not empty; {how}--folder names another")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made a folder: {error.strerror}") from None


def read_header(path: Path) -> Header:
    """Return the header of an experiment; raises `ConfigError`."""
    if not (path / HEADER).exists():
        why = "there is no such folder" if not path.exists() else f"it has no {HEADER}"
        raise ConfigError(f"{path}: no experiment to resume: {why}")
    return _read_struct(path / HEADER, Header)


def list_experiments(root: Path) -> Iterator[tuple[Path, Header | ConfigError]]:
    """Yield the experiments of a folder with their headers, or what is wrong with one."""
    folders = sorted(root.glob(f"*/{HEADER}"), key=lambda path: path.stat().st_mtime)
    for path in folders:
        try:
            yield path.parent, read_header(path.parent)
        except ConfigError as error:
            yield path.parent, error


def count_rows(path: Path) -> int | None:
    """Return how many rows an experiment has; None where it keeps no table."""
    try:
        return max(0, len(tables.read(path / ROWS, MAX_TABLE_BYTES)) - 1)
    except FileProblem:
        return None


_OTHER_FOLDER = "--folder names a new folder"


def _difference(head: Sequence[str], columns: Sequence[str]) -> str:
    """Return why a table with another head is not resumed."""
    for which, names, others in (("no", columns, head), ("a", head, columns)):
        if missing := [name for name in names if name not in others]:
            return f"the table has {which} column {missing[0]}"
    return "the columns of the table are in another order"


def _check_same(path: Path, before: Header, header: Header) -> None:
    """Raise `ConfigError` where an experiment with another header began in the folder."""
    old, new = (_relevant(each) for each in (before, header))
    for key in dict.fromkeys([*old, *new]):
        known = (key in old and key in new) or not key.startswith("config.")
        if known and old.get(key) != new.get(key):
            raise ConfigError(
                f"{path / HEADER}: this {before.kind} began with {key.removeprefix('settings.')} "
                f"= {old.get(key)}, now it is {new.get(key)}; give the same, or {_OTHER_FOLDER}"
            )
    if others := [key for key in (*old, *new) if not (key in old and key in new)]:
        has = "has" if others[0] in old else "has no"
        raise ConfigError(
            f"{path / HEADER}: this {before.kind} began with fishd {before.version}, whose "
            f"configuration {has} {others[0]}, unlike that of now; {_OTHER_FOLDER}"
        )


def _relevant(header: Header) -> dict[str, Any]:
    """Return what the rows depend on, by dotted keys."""
    return {
        key: value
        for key, value in _leaves(msgspec.to_builtins(header)).items()
        if key.partition(".")[0] not in _NOT_COMPARED
        and key.removeprefix("config.").partition(".")[0] not in IRRELEVANT
    }


def _leaves(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            leaves |= _leaves(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def _read_struct(path: Path, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(files.read(path, files.SETTINGS, "an experiment"), type=kind)
    except FileProblem as problem:
        raise ConfigError(f"{path}: {problem}") from None
    except msgspec.MsgspecError as error:
        raise ConfigError(
            f"{path}: not as this fishd ({__version__}) writes it: {error}; {_OTHER_FOLDER}"
        ) from None


def _as_json(value: Struct) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=2)
