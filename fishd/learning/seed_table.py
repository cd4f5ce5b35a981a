"""What several seeds of a training came to: a row for each evaluation, over all seeds."""

import csv
import io
import statistics
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from fishd import files
from fishd.errors import ConfigError

COLUMNS = (
    "steps",
    "seeds",
    "median",
    "lowest",
    "highest",
    "best_median",
    "best_lowest",
    "best_highest",
)
"""Efficiencies of the policies as they stood, and of the best that each seed had had until then."""


class Point(NamedTuple):
    """One deterministic evaluation."""

    steps: int
    efficiency: float
    frequency: float
    """[Hz]"""
    fullness: float
    best: float
    """Best efficiency of this seed so far; a policy that stalls does not count."""


def curve(folder: Path) -> list[Point]:
    """The evaluations in a run folder; none where it has no table of them.

    Raises `ConfigError` where it is another table.
    """
    path = folder / "evaluations.csv"
    points = []
    best = 0.0
    try:
        text = files.read_text(path, files.TABLE, "a table of a training")
        for row in csv.DictReader(io.StringIO(text)):
            efficiency = float(row["efficiency"])
            if row["best"] == "1":
                best = efficiency
            frequency, fullness = float(row["frequency"]), float(row["fullness"])
            points.append(Point(int(row["steps"]), efficiency, frequency, fullness, best))
    except files.NoFile:
        return []
    except files.FileProblem as problem:
        raise ConfigError(f"{path}: {problem}") from None
    except (csv.Error, KeyError, TypeError, ValueError):
        raise ConfigError(f"{path}: no table of a training") from None
    return points


def write_summary(path: Path, folders: Sequence[Path]) -> None:
    """Write a CSV file with the `COLUMNS`, from the run folders of all seeds."""
    at: dict[int, list[Point]] = defaultdict(list)
    for folder in folders:
        for point in curve(folder):
            at[point.steps].append(point)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for steps, points in sorted(at.items()):
            figures = [point.efficiency for point in points], [point.best for point in points]
            spread = [f(values) for values in figures for f in (statistics.median, min, max)]
            writer.writerow([steps, len(points), *spread])
