"""CSV files with a header line, to which rows are appended; a kill does not damage them."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fishd.core import files, text
from fishd.core.files import FileProblem, write_atomically


class Table:
    """A CSV file with a header line; each row is passed to the operating system at once."""

    def __init__(self, path: Path, columns: Iterable[str]) -> None:
        """Create the file if it does not exist; raises OSError."""
        self.path = path
        self.columns = tuple(columns)
        if not path.exists():
            write_atomically(path, lines([self.columns]))

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row, numbers in full precision; raises OSError."""
        values = [_to_plain_number(row.get(column)) for column in self.columns]
        with self.path.open("a", newline="", encoding="utf-8") as file:
            file.write(lines([values]))


def read(path: Path, longest: int = files.MAX_TABLE_BYTES) -> list[list[str]]:
    """Return all rows, the header first, without a last row that a kill left incomplete.

    longest: largest size of the file [bytes]
    Raises `FileProblem`.
    """
    content = files.read_text(path, longest, "a table").removeprefix("\ufeff")  # of a spreadsheet
    try:
        rows = [list(map(_unescape, row)) for row in csv.reader(io.StringIO(content))]
    except csv.Error as error:
        raise FileProblem(f"not a CSV file: {error}") from None
    return rows if content.endswith("\n") else rows[:-1]


def lines(rows: Iterable[Sequence[Any]]) -> str:
    """Return rows as the text of a CSV file, with formulas escaped for spreadsheets."""
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(map(_escape, row) for row in rows)
    return file.getvalue()


def _escape(value: Any) -> Any:
    """Return a value, escaped where it is a text that is not a number."""
    if not isinstance(value, str):
        return value
    try:
        float(value)
    except ValueError:
        return text.for_spreadsheet(value)
    return value


def _unescape(word: str) -> str:
    return word[1:] if word[:1] == "'" and word[1:].startswith(text.FORMULA_CHARACTERS) else word


def _to_plain_number(value: Any) -> Any:
    """Return a numpy number as a Python number, and a boolean as 0 or 1."""
    value = value.item() if hasattr(value, "item") else value
    return int(value) if isinstance(value, bool) else value
