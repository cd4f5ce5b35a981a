"""Table with a row for each picture of a video, which a later run of the same command completes."""

import csv
import fcntl
import math
import os
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.core import files
from fishd.core.errors import FishdError

_MAX_HEAD_BYTES = 2**23
_HEAD_BEGINS = '{"source":{"video":'
Learned = TypeVar("Learned", bound=Struct)


class CannotWriteTable(FishdError, ValueError):
    """A table cannot be written or completed."""


class _Head(Struct, frozen=True):
    source: dict[str, Any]
    learned: msgspec.Raw


class VideoTable(Generic[Learned]):
    """Unfinished table beside the file that `finish` writes; a context manager.

    The unfinished file begins with a line that says what its rows are from.
    """

    def __init__(self, path: Path, source: dict[str, Any], kind: type[Learned]) -> None:
        """Raise `CannotWriteTable` where the file of this path cannot be written.

        source: video, the first key, and options on which the rows depend
        kind: of what is learned from the video before the rows are measured
        """
        self.path, self.source = path, source
        self._kind = kind
        self.learned: Learned | None = None
        """Ground or tail that the rows are measured with; None in a table that has just begun."""
        self.rows = 0
        """Number of pictures in the table."""
        self.part = path.with_name(path.name + ".part")
        if os.path.lexists(path):
            raise CannotWriteTable(f"{path} exists already: give another file with --to")
        try:
            files.check_writable(path)
            self._file = self.part.open("a+", encoding="utf-8", errors="replace", newline="")
        except files.FileProblem as problem:
            raise CannotWriteTable(f"{path}: {problem}") from None
        except OSError as error:
            raise self._failed(error) from None

    def __enter__(self) -> Self:
        """Read what an earlier run has left; raise `CannotWriteTable` if it does not fit."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._resume()
        except BaseException as error:
            self._file.close()
            if isinstance(error, BlockingIOError):
                problem = f"{self.part} is being written by another process"
                raise CannotWriteTable(problem) from None
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        if self.learned is None and self.part.exists() and not self.part.stat().st_size:
            self.part.unlink()

    def _resume(self) -> None:
        """Set `learned` and `rows`, and remove a torn last row."""
        self._file.seek(0)
        line = self._file.readline(_MAX_HEAD_BYTES)
        if not line.endswith("\n") and line.startswith(_HEAD_BEGINS[: len(line)]):
            self._file.truncate(0)  # a kill has torn it
            return
        try:
            head = msgspec.json.decode(line, type=_Head)
            learned = None
            if head.source == self.source:
                learned = msgspec.json.decode(head.learned, type=self._kind)
        except (msgspec.DecodeError, UnicodeError):
            raise CannotWriteTable(
                f"{self.part} is not an unfinished table: remove it, or give another file with --to"
            ) from None
        if learned is None:
            raise CannotWriteTable(
                f"{self.part} is from another video or other options: remove it, or give another "
                "file with --to"
            )
        self.learned, end = learned, self._file.tell()
        while self._file.readline().endswith("\n"):
            self.rows, end = self.rows + 1, self._file.tell()
        self._file.truncate(end)

    def begin(self, learned: Learned) -> None:
        """Store what was learned; raise `CannotWriteTable` if the rows are from something else."""
        if self.learned is None:
            head = _Head(self.source, msgspec.Raw(msgspec.json.encode(learned)))
            try:
                self._file.write(msgspec.json.encode(head).decode() + "\n")
                self._file.flush()
            except OSError as error:
                raise self._failed(error) from None
        elif self.learned != learned:
            raise CannotWriteTable(
                f"{self.part} was measured with another learned tail: remove it, or give another "
                "file with --to"
            )
        self.learned = learned

    def add(self, row: Sequence[str]) -> None:
        """Append the row of a picture."""
        try:
            csv.writer(self._file, lineterminator="\n").writerow(row)
        except OSError as error:
            raise self._failed(error) from None
        self.rows += 1

    def read(self) -> Iterator[list[str]]:
        """Yield the rows."""
        self._file.flush()
        with self.part.open(encoding="utf-8", newline="") as file:
            file.readline()
            yield from csv.reader(file)

    def read_numbers(
        self, places: Sequence[int], reason: int
    ) -> tuple[NDArray[np.float64], Counter[str]]:
        """Return columns, shape (places, rows), NaN where empty, and how often each reason occurs.

        places, reason: numbers of columns. Numbers in reasons are left out.
        """
        numbers, reasons = array("d"), Counter[str]()
        for row in self.read():
            numbers.extend(float(row[place] or math.nan) for place in places)
            if row[reason]:
                reasons[re.sub(r"\d+", "…", row[reason])] += 1
        return np.array(numbers).reshape(-1, len(places)).T, reasons

    def finish(self, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Write the file, and remove the unfinished one; raise `CannotWriteTable`."""
        new = self.path.with_name(f".{self.path.name}.new")
        try:
            with new.open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(columns)
                writer.writerows(rows)
                file.flush()
                os.fsync(file.fileno())
            new.replace(self.path)
        except OSError as error:
            raise self._failed(error) from None
        finally:
            new.unlink(missing_ok=True)
        self.part.unlink()

    def _failed(self, error: OSError) -> CannotWriteTable:
        return CannotWriteTable(f"{self.part} cannot be written: {error.strerror or error}")


def format_cell(value: float | None, digits: int) -> str:
    """Return a number with this many decimals; empty for None and NaN."""
    return "" if value is None or math.isnan(value) else f"{value:.{digits}f}"
