"""Table of the fin angles of a video, which a later run of the same command completes."""

import csv
import fcntl
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from msgspec import Struct

from fishd.camera.tail.learned import Learned
from fishd.core import files
from fishd.core.errors import FishdError
from fishd.core.tail_reading import TailReading

COLUMNS = ("video_time", "fin_angle", "fin_angle_uncertainty", "tip_column", "tip_row", "reason")
MM_COLUMNS = ("tip_along_mm", "tip_across_mm")
_MAX_HEAD_BYTES = 2**23


class CannotWriteTable(FishdError, ValueError):
    """A table cannot be written or completed."""


class Source(Struct, frozen=True, kw_only=True):
    """Video and options on which the rows of a table depend."""

    video: str
    size: int
    modified: int
    rate: float | None
    turn: int
    length_mm: float | None


class _Head(Struct, frozen=True):
    source: Source
    learned: Learned


class TailTable:
    """Unfinished table beside the file that `finish` writes; a context manager.

    The unfinished file begins with a line that says what its rows are from.
    """

    def __init__(self, path: Path, source: Source) -> None:
        """Raise `CannotWriteTable` where the file of this path cannot be written."""
        self.path, self._source = path, source
        self.learned: Learned | None = None
        """Tail from which the rows are; None in a table that has just begun."""
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
        if not line:
            return
        try:
            head = msgspec.json.decode(line, type=_Head)
        except (msgspec.DecodeError, UnicodeError):
            raise CannotWriteTable(
                f"{self.part} is not an unfinished table: remove it, or give another file with --to"
            ) from None
        if head.source != self._source:
            raise CannotWriteTable(
                f"{self.part} is from another video or other options: remove it, or give another "
                "file with --to"
            )
        self.learned, end = head.learned, self._file.tell()
        while self._file.readline().endswith("\n"):
            self.rows, end = self.rows + 1, self._file.tell()
        self._file.truncate(end)

    def begin(self, learned: Learned) -> None:
        """Store what was learned; raise `CannotWriteTable` if the rows are from another tail."""
        if self.learned is None:
            self._write(msgspec.json.encode(_Head(self._source, learned)).decode() + "\n")
        elif self.learned != learned:
            raise CannotWriteTable(
                f"{self.part} was measured with another learned tail: remove it, or give another "
                "file with --to"
            )
        self.learned = learned

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns."""
        assert self.learned
        return COLUMNS + (MM_COLUMNS if self.learned.pixels_per_mm else ())

    def add(self, reading: TailReading) -> None:
        """Append the row of a picture."""
        assert self.learned
        tip = reading.tip or (None, None)
        places: Sequence[float | None] = (None, None)
        scale = self.learned.pixels_per_mm
        if scale and reading.tip:
            places = (self.learned.to_axis(np.array(reading.tip)) / scale).tolist()
        row = [
            *(_format(value, 6) for value in (reading.time, reading.alpha, reading.uncertainty)),
            *(_format(value, 2) for value in tip),
            reading.reason,
            *(_format(value, 3) for value in places if scale),
        ]
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

    def finish(
        self, names: Sequence[str] = (), more: Callable[[list[str]], list[str]] = lambda _: []
    ) -> None:
        """Write the file, and remove the unfinished one; raise `CannotWriteTable`.

        names: of further columns; more: their values for a row
        """
        new = self.path.with_name(f".{self.path.name}.new")
        try:
            with new.open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow([*self.columns, *names])
                writer.writerows([*row, *more(row)] for row in self.read())
                file.flush()
                os.fsync(file.fileno())
            new.replace(self.path)
        except OSError as error:
            raise self._failed(error) from None
        finally:
            new.unlink(missing_ok=True)
        self.part.unlink()

    def _write(self, line: str) -> None:
        try:
            self._file.write(line)
            self._file.flush()
        except OSError as error:
            raise self._failed(error) from None

    def _failed(self, error: OSError) -> CannotWriteTable:
        return CannotWriteTable(f"{self.part} cannot be written: {error.strerror or error}")


def _format(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
