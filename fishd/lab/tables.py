"""CSV files with a head, to which rows are added one by one, and which survive a kill."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fishd.core import files
from fishd.core.files import FileProblem, write_atomically


class Table:
    """A CSV file with a head; every row is passed to the operating system at once."""

    def __init__(self, path: Path, columns: Iterable[str]) -> None:
        """Makes the file if it does not exist; raises OSError."""
        self.path = path
        self.columns = tuple(columns)
        if not path.exists():
            write_atomically(path, lines([self.columns]))

    def add(self, row: Mapping[str, Any]) -> None:
        """One row; numbers in full precision. Raises OSError."""
        values = [_plain(row.get(column)) for column in self.columns]
        with self.path.open("a", newline="", encoding="utf-8") as file:
            file.write(lines([values]))


def read(path: Path, longest: int = files.TABLE) -> list[list[str]]:
    """All rows, the head first; a last one that a kill has cut off is left out.

    longest: more is not read [bytes]
    Raises `FileProblem`.
    """
    text = files.read_text(path, longest, "a table")
    try:
        rows = list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise FileProblem(f"not a CSV file: {error}") from None
    return rows if text.endswith("\n") else rows[:-1]


def lines(rows: Iterable[Sequence[Any]]) -> str:
    """Rows as the text of a CSV file."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _plain(value: Any) -> Any:
    """Numbers of numpy as those of Python, booleans as 0 and 1."""
    value = value.item() if hasattr(value, "item") else value
    return int(value) if isinstance(value, bool) else value
