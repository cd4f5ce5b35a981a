"""CSV files with a head, to which rows are added one by one, and which survive a kill."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fishd.core import files, text
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
    content = files.read_text(path, longest, "a table")
    try:
        rows = [list(map(_unescaped, row)) for row in csv.reader(io.StringIO(content))]
    except csv.Error as error:
        raise FileProblem(f"not a CSV file: {error}") from None
    return rows if content.endswith("\n") else rows[:-1]


def lines(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as the text of a CSV file, in which a spreadsheet computes nothing."""
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(map(_escaped, row) for row in rows)
    return file.getvalue()


def _escaped(value: Any) -> Any:
    """Escape a text that is not a number."""
    if not isinstance(value, str):
        return value
    try:
        float(value)
    except ValueError:
        return text.for_spreadsheet(value)
    return value


def _unescaped(word: str) -> str:
    return word[1:] if word[:1] == "'" and word[1:].startswith(text.FORMULAS) else word


def _plain(value: Any) -> Any:
    """Numbers of numpy as those of Python, booleans as 0 and 1."""
    value = value.item() if hasattr(value, "item") else value
    return int(value) if isinstance(value, bool) else value
