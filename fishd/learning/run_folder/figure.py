"""Figure of a training: thrust of the policy at each evaluation."""

import math
from pathlib import Path
from typing import Any

from fishd.lab.drawing import BLUE, PURPLE, open_figure
from fishd.learning.run_folder.tables import read_evaluations


def draw(path: Path, folder: Path) -> None:
    """Draw the evaluations of a training into a file; raises `FishdError`."""
    with open_figure(path, (6.0, 4.0)) as figure:
        draw_training(figure.subplots(), folder)


def draw_training(axis: Any, folder: Path) -> None:
    """Draw the thrust of the policy on its fish, and on the worst of the other fish if tried."""
    axis.set_title("training")
    axis.set_xlabel("steps")
    axis.set_ylabel("% of the best square wave")
    evaluations = read_evaluations(folder)
    if not evaluations:
        axis.text(0.5, 0.5, "no evaluation", ha="center", transform=axis.transAxes)
        return
    steps = [evaluation.steps for evaluation in evaluations]
    for shares, label, colour in (
        ([evaluation.relative_thrust for evaluation in evaluations], "its fish", BLUE),
        ([item.lowest_relative_thrust for item in evaluations], "worst fish tried", PURPLE),
    ):
        if any(share is not None for share in shares):
            values = [100.0 * (math.nan if share is None else share) for share in shares]
            axis.plot(steps, values, color=colour, marker=".", label=label)
    axis.set_ylim(0.0, 105.0)
    axis.legend(loc="lower right")
