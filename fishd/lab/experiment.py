"""The folder of an experiment: a header, a table of rows, recordings, and state for resuming.

sweep, optimise and adapt write all results into such a folder; a training marks its folder with
the same header. Files are written atomically, and each row immediately.
"""

import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import msgspec
from msgspec import Struct

from fishd import __version__
from fishd.core import files, text
from fishd.core.errors import ConfigError, FishdError
from fishd.core.experiments import CurvePoint, Estimate
from fishd.core.files import FileProblem, write_atomically
from fishd.core.process.lockfile import LockHeld, NotALock, find_lock_holder, locked
from fishd.lab import tables
from fishd.lab.tables import Table
from fishd.recording.folder import EXPERIMENT, runs_folder
from fishd.recording.part_file import PART_SUFFIX, SUFFIX

HEADER, ROWS, RESULT = EXPERIMENT, "rows.csv", "result.json"
LOCK = "experiment"
"""File of a folder whose lock is held while something is measured there."""
MAX_TABLE_BYTES = 256 * 2**20
"""Size of the largest table [bytes]: 2.6 kB for each of the points that a sweep may have."""
IRRELEVANT_KEYS = ("control", "name", "panel", "realtime", "start", "state_folder", "telemetry")
"""Sections and keys of a configuration that do not affect the thrust."""
_NOT_COMPARED = ("began", "command", "ended", "number", "version")

On = Literal["live", "simulation"]
T = TypeVar("T", bound=Struct)


class Progress(Protocol):
    """Display of an experiment's progress, implemented by `fishd.cli.progress.Lines`."""

    def done(self, line: str, amount: float, point: CurvePoint | None = None) -> None:
        """Show a finished step; amount: amount of the total that is finished by now."""

    def at(self, amount: float, result: str | None = None) -> None:
        """Show the amount of the total that is finished by now, and a new preliminary result."""

    def estimate(self, estimates: Sequence[Estimate], point: CurvePoint | None = None) -> None:
        """Show the best values until now, and a new point of their curve."""

    def warn(self, line: str) -> None:
        """Show a warning on standard error."""


class Header(Struct, frozen=True, kw_only=True):
    """The facts that all rows of an experiment share; only an equal header resumes a folder."""

    kind: str
    """Verb of the experiment, such as `sweep`."""
    on: On
    config: dict[str, Any] = {}
    """Configuration of the fish, as plain data."""
    settings: dict[str, Any] = {}
    """Further settings on which the rows depend."""
    force_unit: str = "N"
    command: list[str] = []
    """Arguments of the verb, which `--resume` starts from."""
    began: str = ""
    """Local time of the start, in ISO 8601."""
    ended: str | None = None
    """Local time at which it was complete, in ISO 8601; empty before, None where it is unknown."""
    version: str = __version__
    number: int = 0
    """Running number among the experiments of a folder, which gives their order; 0 without one."""


class Experiment:
    """A folder with the results of an experiment, written row by row; see `open_experiment`."""

    def __init__(self, path: Path, header: Header) -> None:
        self.path = path
        self.header = header

    @property
    def resume_command(self) -> str:
        """Return the command line that resumes the experiment."""
        return shlex.join(["fishctl", *self.header.kind.split(), "--resume", str(self.path)])

    def open_table(self, columns: Sequence[str], name: str = ROWS) -> "KeptTable":
        """Return a table of the folder; a missing one is created.

        Raises `ConfigError` where the table has other columns, and `FishdError`.
        """
        return KeptTable(self, columns, name)

    def once(self, name: str, kind: type[T], compute: Callable[[], T]) -> T:
        """Return the struct in a file of the folder; compute and write it if there is none.

        Raises the errors of `read_struct`, `write_struct` and `compute`.
        """
        value = self.read_struct(name, kind)
        if value is None:
            value = compute()
            self.write_struct(name, value)
        return value

    def make_folder(self, name: str) -> Path:
        """Create a subfolder and return its path; raises `FishdError`."""
        with self.os_errors_as_fishd_errors():
            (self.path / name).mkdir(exist_ok=True)
        return self.path / name

    def write(self, name: str, content: str | bytes) -> None:
        """Write a file into the folder; raises `FishdError`."""
        with self.os_errors_as_fishd_errors():
            write_atomically(self.path / name, content)

    def read_struct(self, name: str, kind: type[T]) -> T | None:
        """Return a struct that `write_struct` wrote; None where the file does not exist.

        Raises `ConfigError` where the file holds something else.
        """
        path = self.path / name
        return _read_struct(path, kind) if path.exists() else None

    def write_struct(self, name: str, value: Struct) -> None:
        """Write a struct as JSON; raises `FishdError`."""
        self.write(name, _as_json(value))

    def write_result(self, result: Any) -> None:
        """Write the result of the experiment, as its JSON output has it; raises `FishdError`."""
        self.write(RESULT, msgspec.json.encode(result))

    def recording(self, stem: str) -> Path:
        """Return an unused path for a recording; an incomplete recording keeps its name."""
        return files.unused_path(self.path, stem, SUFFIX, SUFFIX + PART_SUFFIX)

    @contextmanager
    def os_errors_as_fishd_errors(self) -> Iterator[None]:
        """Raise `FishdError` in place of an OSError."""
        try:
            yield
        except OSError as error:
            raise FishdError(
                f"{error.filename or self.path}: cannot be written: {error.strerror}; earlier "
                "results are kept"
            ) from None


class KeptTable:
    """A table in the folder of an experiment, written row by row."""

    def __init__(self, experiment: Experiment, columns: Sequence[str], name: str) -> None:
        """columns: columns of the table in order

        Raises the errors of `Experiment.open_table`.
        """
        self._experiment, self._name = experiment, name
        path, expected = experiment.path / name, list(columns)
        rows: list[list[str]] = []
        if path.exists():
            try:
                table = tables.read(path, MAX_TABLE_BYTES)
            except FileProblem as problem:
                raise ConfigError(f"{path}: {problem}; {_OTHER_FOLDER}") from None
            if not table:
                raise ConfigError(
                    f"{path}: it has no complete line; delete it to measure everything again, or "
                    f"{_OTHER_FOLDER}"
                )
            head, *rows = table
            if head != expected:
                raise ConfigError(
                    f"{path}: {_describe_difference(head, expected)}; {_OTHER_FOLDER}"
                )
            rows = [row for row in rows if len(row) == len(expected)]
            complete = tables.lines([head, *rows])
            if path.read_bytes() != complete.encode():
                experiment.write(name, complete)
        with experiment.os_errors_as_fishd_errors():
            self._table = Table(path, expected)
        self.rows = [dict(zip(expected, row, strict=True)) for row in rows]
        """Complete rows when the table was opened; a row that a kill has cut off is removed."""

    def add(self, row: Mapping[str, Any]) -> None:
        """Add a row, numbers in full precision; raises `FishdError`."""
        with self._experiment.os_errors_as_fishd_errors():
            self._table.add(row)

    def replace(self, rows: Sequence[Mapping[str, str]]) -> None:
        """Replace the rows; raises `FishdError`."""
        columns = self._table.columns
        lines = [columns, *([row[column] for column in columns] for row in rows)]
        self._experiment.write(self._name, tables.lines(lines))


def default_folder(kind: str) -> Path:
    """Return a path in the folder of all runs, with date and time in its name."""
    name = f"{kind.split()[-1]}-{datetime.now():%Y%m%d-%H%M%S}"
    return files.unused_path(runs_folder(), name, "")  # it may exist: the clock was set back


@contextmanager
def open_experiment(path: Path, header: Header, *, resume: bool = False) -> Iterator[Experiment]:
    """Start an experiment in a new folder, or resume one; lock the folder while this lasts.

    The experiment counts as finished unless this ends with an exception.

    resume: resume an experiment, whose header must be equal
    Raises `ConfigError` where the folder is in use, belongs to another experiment, or cannot be
    created.
    """
    if resume:
        _check_same(path, read_header(path), header)
    _make_folder(path)
    try:
        with locked(path / LOCK, remove=True):
            experiment = Experiment(path, header)
            if not resume:
                check_free(path)
                started = _with_start(path, header)
                experiment.write_struct(HEADER, msgspec.structs.replace(started, ended=""))
            yield experiment
            ended = msgspec.structs.replace(read_header(path), ended=_now())
            experiment.write_struct(HEADER, ended)
    except LockHeld as taken:
        raise ConfigError(f"{path}: another experiment uses it, process {taken.pid}") from None
    except NotALock as error:
        raise ConfigError(f"{error.filename}: {error.strerror}") from None


def mark_folder(path: Path, kind: str, on: On, command: Sequence[str] = ()) -> None:
    """Create a folder with a header, for an experiment that writes its other files itself.

    command: arguments of its verb
    Raises `ConfigError` where the folder is not empty or cannot be created, and OSError.
    """
    check_free(path)
    _make_folder(path)
    header = Header(kind=kind, on=on, command=list(command))
    write_atomically(path / HEADER, _as_json(_with_start(path, header)))


def _make_folder(path: Path) -> None:
    with files.os_errors(ConfigError, f"{path}: the folder cannot be created"):
        path.mkdir(parents=True, exist_ok=True)


def _with_start(path: Path, header: Header) -> Header:
    """Return the header of an experiment that begins now: with its time and running number."""
    root = path.absolute().parent
    known = (entry.number for _, entry in list_experiments(root) if isinstance(entry, Header))
    return msgspec.structs.replace(header, began=_now(), number=max(known, default=0) + 1)


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")


def check_free(path: Path) -> None:
    """Raise `ConfigError` where a folder exists and is not empty."""
    with files.os_errors(ConfigError, f"{path}: the folder cannot be created"):
        if path.exists() and any(not file.name.endswith(".lock") for file in path.iterdir()):
            hint = f"resume it with --resume {path}, or " if (path / HEADER).exists() else ""
            raise ConfigError(
                f"{path}: the folder is not empty; {hint}choose another with --folder"
            )


def read_header(path: Path) -> Header:
    """Return the header of an experiment; raises `ConfigError`."""
    if not (path / HEADER).exists():
        why = "there is no such folder" if not path.exists() else f"it has no {HEADER}"
        raise ConfigError(f"{path}: no experiment to resume: {why}")
    return _read_struct(path / HEADER, Header)


def list_experiments(root: Path) -> Iterator[tuple[Path, Header | ConfigError]]:
    """Yield the experiments of a folder, each with its header or the error of reading it.

    They are in the order of their numbers. Those without one come first, by name.
    """
    entries: list[tuple[int, Path, Header | ConfigError]] = []
    for path in sorted(root.glob(f"*/{HEADER}")):
        try:
            header = read_header(path.parent)
            entries.append((header.number, path.parent, header))
        except ConfigError as error:
            entries.append((0, path.parent, error))
    for _, path, entry in sorted(entries, key=itemgetter(0)):
        yield path, entry


def count_rows(path: Path) -> int | None:
    """Return the number of rows of an experiment; None where it has no table."""
    try:
        return max(0, len(tables.read(path / ROWS, MAX_TABLE_BYTES)) - 1)
    except FileProblem:
        return None


SEARCHES = ("optimise", "identify", "adapt", "learn ppo")
"""Kinds of experiments whose rows are candidates: the best of them is the luckiest one."""


class Answer(NamedTuple):
    """Result of an experiment or, before its end, of its rows, for one line of a list."""

    thrust: float | None = None
    """Thrust of its result, or largest thrust of its table before its end [N].

    A search has none before its end. Of a comparison, it is that of the chosen contestant.
    """
    thrust_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust`, statistical [N]."""
    total_ci95: float | None = None
    """The same with the calibration [N]; None where that is not known."""
    summary: str = ""
    """Result other than a thrust, in words."""
    duration: float | None = None
    """Tank time; None where the result does not have it [s]."""
    problem: str = ""
    """Reason why the result cannot be read; empty if it can, or if there is none."""


def find_answer(path: Path, kind: str = "") -> Answer:
    """Return the result of an experiment; kind: its verb."""
    try:
        results = read_result(path)
        if not results and kind not in SEARCHES:
            results = read_rows(path)
    except FileProblem as problem:
        return Answer(problem=str(problem))
    results = [r for r in results if r.get("verdict") in ("wins", "chosen")] or results
    answers = [
        Answer(
            read_number(result.get("thrust")),
            read_number(result.get("thrust_ci95")),
            read_number(result.get("total_ci95")),
            text.line(str(result.get("summary", ""))),
            read_number(result.get("tank_time", result.get("seconds"))),
        )
        for result in results
    ]
    return max(
        answers,
        key=lambda answer: -math.inf if answer.thrust is None else answer.thrust,
        default=Answer(),
    )


def read_result(path: Path) -> list[dict[str, Any]]:
    """Return the rows of the result of an experiment; none before its end; raise `FileProblem`."""
    if not (path / RESULT).exists():
        return []
    try:
        content = files.read(path / RESULT, MAX_TABLE_BYTES, "a result")
        results = msgspec.json.decode(content, type=list[dict[str, Any]] | dict[str, Any])
    except (FileProblem, msgspec.DecodeError) as error:
        problem = error if isinstance(error, FileProblem) else f"not a result: {error}"
        raise FileProblem(
            f"{path / RESULT}: {text.line(str(problem))}; delete it, the rows are kept"
        ) from None
    return results if isinstance(results, list) else [results]


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of the table of an experiment; none where it has no table."""
    try:
        head, *rows = tables.read(path / ROWS, MAX_TABLE_BYTES) or [[]]
        return [dict(zip(head, row, strict=False)) for row in rows]
    except FileProblem:
        return []


def read_number(value: Any) -> float | None:
    """Return a finite number of a table or of JSON; None for anything else."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def is_in_use(path: Path) -> bool:
    """Return whether a process measures in the folder of an experiment."""
    return bool(find_lock_holder(path / LOCK))


_OTHER_FOLDER = "choose a new folder with --folder"


def _describe_difference(head: Sequence[str], columns: Sequence[str]) -> str:
    """Return the difference between the columns of a table and the expected ones."""
    for which, names, others in (("no", columns, head), ("a", head, columns)):
        if missing := [name for name in names if name not in others]:
            return f"the table has {which} column {missing[0]}"
    return "the columns of the table are in another order"


def _check_same(path: Path, before: Header, header: Header) -> None:
    """Raise `ConfigError` where the experiment in the folder has another header."""
    old, new = (_relevant_values(each) for each in (before, header))
    for key in dict.fromkeys([*old, *new]):
        known = (key in old and key in new) or not key.startswith("config.")
        if known and old.get(key) != new.get(key):
            raise ConfigError(
                f"{path / HEADER}: this {before.kind} began with {key.removeprefix('settings.')} = "
                f"{old.get(key)}, now it is {new.get(key)}; give the same value, or {_OTHER_FOLDER}"
            )
    if others := [key for key in (*old, *new) if not (key in old and key in new)]:
        has = "has" if others[0] in old else "has no"
        raise ConfigError(
            f"{path / HEADER}: this {before.kind} began with fishd {before.version}, whose "
            f"configuration {has} {others[0]}, unlike that of this fishd; {_OTHER_FOLDER}"
        )


def _relevant_values(header: Header) -> dict[str, Any]:
    """Return the values on which the rows depend, as JSON has them, by dotted keys."""
    return {
        key: value
        for key, value in flatten(msgspec.json.decode(msgspec.json.encode(header))).items()
        if key.partition(".")[0] not in _NOT_COMPARED
        and key.removeprefix("config.").partition(".")[0] not in IRRELEVANT_KEYS
    }


def flatten(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values in nested tables by their dotted keys."""
    leaves: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[prefix + key] = value
    return leaves


def _read_struct(path: Path, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(
            files.read(path, files.MAX_SETTINGS_BYTES, "an experiment"), type=kind
        )
    except FileProblem as problem:
        raise ConfigError(f"{path}: {problem}; {_OTHER_FOLDER}") from None
    except msgspec.MsgspecError as error:
        raise ConfigError(
            f"{path}: fishd {__version__} cannot read it: {error}; {_OTHER_FOLDER}"
        ) from None


def _as_json(value: Struct) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=2)
