"""Figures of trainings: thrust of the policy at each evaluation."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fishd.lab import tables
from fishd.lab.drawing import BLUE, PURPLE, open_figure
from fishd.learning.run_folder.tables import SEEDS, read_evaluations


def draw(path: Path, folder: Path) -> None:
    """Draw the evaluations of a training into a file; raises `FishdError`.

    That is the thrust of the policy on its fish, and on the worst of the other fish if tried.
    """
    with open_figure(path, (6.0, 4.0)) as figure:
        axis = figure.subplots()
        evaluations = read_evaluations(folder)
        if not _prepare(axis, "training", evaluations):
            return
        steps = [evaluation.steps for evaluation in evaluations]
        ours = [evaluation.relative_thrust for evaluation in evaluations]
        worst = [evaluation.lowest_relative_thrust for evaluation in evaluations]
        for shares, label, colour in (
            (ours, "fish of the training", BLUE),
            (worst, "worst fish tried", PURPLE),
        ):
            if any(share is not None for share in shares):
                values = [100.0 * (math.nan if share is None else share) for share in shares]
                axis.plot(steps, values, color=colour, marker=".", label=label)
        axis.legend(loc="lower right")


def draw_seeds(path: Path, folder: Path) -> None:
    """Draw the table of a training with several seeds into a file; raises `FishdError`."""
    with open_figure(path, (6.0, 4.0)) as figure:
        axis = figure.subplots()
        head, *rows = tables.read(folder / SEEDS)
        if not _prepare(axis, "several seeds", rows):
            return
        columns = dict(zip(head, np.array(rows, float).T, strict=True))
        steps = columns["steps"]
        shares = {name: 100.0 * values for name, values in columns.items()}
        low, high = shares["best_lowest"], shares["best_highest"]
        axis.fill_between(
            steps, low, high, step="post", color=BLUE, alpha=0.15, linewidth=0, label="all seeds"
        )
        axis.step(
            steps, shares["best_median"], where="post", color=BLUE, label="best so far, median"
        )
        axis.plot(steps, shares["median"], color=PURPLE, linewidth=0.8, label="latest, median")
        axis.legend(loc="lower right")


def _prepare(axis: Any, title: str, rows: Sequence[Any]) -> bool:
    """Label the axes of a training; return whether there is anything to draw."""
    axis.set_title(title)
    axis.set_xlabel("steps")
    axis.set_ylabel("% of the best square wave")
    axis.set_ylim(0.0, 105.0)
    if not rows:
        axis.text(0.5, 0.5, "no evaluation", ha="center", transform=axis.transAxes)
    return bool(rows)
