"""The CSV files of a run, which continue after a resume, and the summary of several seeds."""

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from fishd.core.errors import ConfigError
from fishd.core.files import FileProblem, NoFile, write_atomically
from fishd.lab import tables
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.run_folder.checkpoints import CheckpointError

PROGRESS = {
    "steps": "tank/steps",
    "tank_time": "tank/time",
    "reward": "rollout/reward",
    "thrust": "rollout/thrust",
    "relative_thrust": "rollout/relative_thrust",
    "frequency": "rollout/frequency",
    "fullness": "rollout/fullness",
    "lost_ticks": "tank/lost_ticks",
    "blind_ticks": "tank/blind_ticks",
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
EVALUATIONS, SEEDS = "evaluations.csv", "seeds.csv"
SUMMARY = (
    "steps",
    "seeds",
    "median",
    "lowest",
    "highest",
    "best_median",
    "best_lowest",
    "best_highest",
)
"""Columns of seeds.csv: relative thrust of the current policies, and of each seed's best yet."""


class Table(tables.Table):
    """A table whose rows contain the number of steps before them."""

    def keep_until(self, steps: int) -> None:
        """Drop the rows of later steps, which a resumed run repeats.

        Raises `CheckpointError` where the file is not such a table.
        """
        try:
            head, *rows = tables.read(self.path)
            at = head.index("steps")
            if tuple(head) != self.columns:
                raise ValueError(head)
            complete = [row for row in rows if len(row) == len(head)]
            kept = [row for row in complete if int(row[at]) <= steps]
        except (ValueError, FileProblem):
            raise CheckpointError(
                f"{self.path}: not a table of a training; move it away, and a new one is begun"
            ) from None
        write_atomically(self.path, tables.lines([self.columns, *kept]))


def read_evaluations(folder: Path) -> list[Evaluation]:
    """Read the evaluations of a run; empty where it has no such table.

    Raises `ConfigError` where the file is another table.
    """
    path = folder / EVALUATIONS
    try:
        head, *rows = tables.read(path)
        given = [{key: text for key, text in zip(head, row, strict=True) if text} for row in rows]
        return msgspec.convert(given, list[Evaluation], strict=False)
    except NoFile:
        return []
    except FileProblem as problem:
        raise ConfigError(f"{path}: {problem}") from None
    except ValueError:
        raise ConfigError(
            f"{path}: not a table of evaluations; move it away, and a new one is begun"
        ) from None


def best_so_far(evaluations: Iterable[Evaluation]) -> list[float]:
    """Return the relative thrust of the best policy until each evaluation, stalled excluded."""
    best = 0.0
    return [
        best := evaluation.relative_thrust if evaluation.best else best
        for evaluation in evaluations
    ]


def write_summary(path: Path, folders: Sequence[Path]) -> None:
    """Write seeds.csv from the run folders of all seeds: a row for each evaluation.

    A training that has ended keeps its last figures.
    """
    runs = []
    for folder in folders:
        evaluations = read_evaluations(folder)
        shares = zip(evaluations, best_so_far(evaluations), strict=True)
        runs.append(
            {evaluation.steps: (evaluation.relative_thrust, best) for evaluation, best in shares}
        )
    lines: list[Sequence[Any]] = [SUMMARY]
    latest: dict[int, tuple[float, float]] = {}
    for steps in sorted(set().union(*runs)):
        latest |= {number: run[steps] for number, run in enumerate(runs) if steps in run}
        pairs = list(latest.values())
        columns = list(zip(*pairs, strict=True))
        spread = [f(values) for values in columns for f in (statistics.median, min, max)]
        lines.append([steps, len(pairs), *spread])
    write_atomically(path, tables.lines(lines))
