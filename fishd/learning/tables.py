"""The CSV files of a run: one row an update, one row an evaluation; they go on after a resume."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter

from fishd import files
from fishd.files import FileProblem
from fishd.learning.checkpoints import CheckpointError
from fishd.learning.whole import write_whole

PROGRESS = {
    "steps": "tank/steps",
    "tank_time": "tank/time",
    "reward": "rollout/reward",
    "thrust": "rollout/thrust",
    "efficiency": "rollout/efficiency",
    "frequency": "rollout/frequency",
    "fullness": "rollout/fullness",
    "lost": "tank/lost",
    "paused": "tank/paused",
    "learning_rate": "train/learning_rate",
    "loss": "train/loss",
    "policy_loss": "train/policy_gradient_loss",
    "value_loss": "train/value_loss",
    "entropy_loss": "train/entropy_loss",
    "kl": "train/approx_kl",
    "clip_fraction": "train/clip_fraction",
    "explained_variance": "train/explained_variance",
    "deviation": "train/std",
}
"""Columns of progress.csv, and the keys that they have in TensorBoard."""


class Table:
    """A CSV file with a head; every row is on disk, for all that this process can do, at once."""

    def __init__(self, path: Path, columns: tuple[str, ...]) -> None:
        self._path = path
        self._columns = columns
        if not path.exists():
            write_whole(path, _lines([list(columns)]))

    def add(self, row: Mapping[str, Any]) -> None:
        """One row; numbers in full precision."""
        self._append([_plain(row[column]) for column in self._columns])

    def keep_until(self, steps: int) -> None:
        """Drop the rows of steps that a resumed run is going to do again.

        Raises `CheckpointError` where it is no such table.
        """
        try:
            head, *rows = read_rows(self._path)
            at = head.index("steps")
            whole = [row for row in rows if len(row) == len(head)]  # the last may be cut off
            kept = [row for row in whole if int(row[at]) <= steps]
        except (ValueError, FileProblem):
            raise CheckpointError(
                f"{self._path}: no table of a training; move it away, and a new one is begun"
            ) from None
        write_whole(self._path, _lines([head, *kept]))

    def _append(self, row: list[Any]) -> None:
        with self._path.open("a", newline="", encoding="utf-8") as file:
            file.write(_lines([row]))


class Progress(KVWriter):
    """Writes what stable-baselines3 logs in an update as a row of progress.csv."""

    def __init__(self, path: Path) -> None:
        self.table = Table(path, tuple(PROGRESS))

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,
    ) -> None:
        """One row."""
        self.table.add({column: key_values.get(key) for column, key in PROGRESS.items()})

    def close(self) -> None:
        """Nothing is held open."""


def read_rows(path: Path) -> list[list[str]]:
    """The rows of such a table; raises `FileProblem`."""
    text = files.read_text(path, files.TABLE, "a table of a training")
    try:
        return list(csv.reader(io.StringIO(text)))
    except csv.Error as error:
        raise FileProblem(f"not a CSV file: {error}") from None


def _lines(rows: list[list[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _plain(value: Any) -> Any:
    """numpy's numbers as Python's, truth as 0 and 1."""
    value = value.item() if hasattr(value, "item") else value
    return int(value) if isinstance(value, bool) else value
