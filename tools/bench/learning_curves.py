"""Figure of the learning curves of `tools/bench learning`."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fishd.lab.drawing import BLUE, GREY, open_figure

_COLUMNS = 3
_FIRST, _TICKS = 200, (200, 1000, 5000, 20_000)
"""First number of control steps on the axis, and its ticks."""
_LOWEST = 60
"""Relative thrust at the begin of the axis [%]."""


def learning_curves(
    path: Path, curves: Mapping[str, Sequence[tuple[Sequence[int], Sequence[float]]]], goal: float
) -> None:
    """Draw relative thrust against steps: a panel for each training, with seeds and their median.

    curves: seeds of each training, each as steps and the relative thrust of its best policy so far
    goal: relative thrust that is drawn as a line
    Raises `FishdError` where the file cannot be written, and `MissingPackage`.
    """
    steps_shown = max(seeds[0][0][-1] for seeds in curves.values())
    rows = math.ceil(len(curves) / _COLUMNS)
    with open_figure(path, (6.4, 0.5 + 1.6 * rows)) as figure:
        grid = figure.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
        for axis, (label, seeds) in zip(grid.flat, curves.items(), strict=False):
            axis.set_title(label, fontsize=8, fontweight="normal")
            steps = np.array(seeds[0][0])
            relative_thrust = 100.0 * np.array([relative_thrusts for _, relative_thrusts in seeds])
            axis.axhline(100.0 * goal, color=GREY, linewidth=0.7, linestyle="--")
            axis.step(steps, relative_thrust.T, where="post", color=BLUE, linewidth=0.6, alpha=0.4)
            axis.step(steps, np.median(relative_thrust, 0), where="post", color=BLUE, linewidth=1.8)
        for axis in grid.flat[len(curves) :]:
            axis.set_axis_off()
        axis = grid[0][0]
        axis.set_xscale("log")
        axis.set_xlim(_FIRST, steps_shown)
        ticks = [tick for tick in _TICKS if _FIRST <= tick <= steps_shown]
        axis.set_xticks(ticks, [f"{tick:,}".replace(",", " ") for tick in ticks])
        axis.minorticks_off()
        axis.set_ylim(_LOWEST, 101)
        figure.supxlabel(f"control steps; dashed line: {100.0 * goal:.0f} %", fontsize=9)
        figure.supylabel(f"relative thrust so far (%, from {_LOWEST} % up)", fontsize=9)
