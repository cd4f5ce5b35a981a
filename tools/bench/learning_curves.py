"""Figure of the learning curves of `tools/bench learning`."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np

from fishd.lab.drawing import open_figure

_CURVES = (
    ("#0072b2", "-", 2.6),
    ("#d55e00", (0, (3, 1.5)), 1.4),
    ("#009e73", "-", 1.2),
    ("#cc79a7", (0, (1, 1)), 1.6),
    ("#000000", (0, (6, 1.5, 1, 1.5)), 1.1),
    ("#e69f00", "-", 0.9),
)
"""Colours, line styles and widths [points] of the curves.

The colours, by Okabe and Ito, are suitable for colour-blind people. Later curves are thinner or
have gaps, so that an earlier curve below remains visible."""
_FIRST, _TICKS = 200, (200, 500, 1000, 2000, 5000, 10_000, 20_000)
"""First number of control steps on the axis, and its ticks."""
_LOWEST = 60
"""Relative thrust at the begin of the axis [%]."""


def learning_curves(
    path: Path, curves: Mapping[str, Sequence[tuple[Sequence[int], Sequence[float]]]], goal: float
) -> None:
    """Draw relative thrust against steps: median and range of the seeds of each training.

    curves: seeds of each training, each as steps and relative thrusts
    goal: relative thrust that is drawn as a line
    Raises `FishdError` where the file cannot be written, and `MissingPackage`.
    """
    steps_shown = max(seeds[0][0][-1] for seeds in curves.values())
    with open_figure(path, (6.4, 3.8)) as figure:
        axis = figure.subplots()
        for (color, style, width), (label, seeds) in zip(cycle(_CURVES), curves.items()):
            steps = np.array(seeds[0][0])
            relative_thrust = 100.0 * np.array([relative_thrusts for _, relative_thrusts in seeds])
            low, high = relative_thrust.min(0), relative_thrust.max(0)
            axis.fill_between(steps, low, high, color=color, alpha=0.1, linewidth=0)
            for edge in (low, high):
                axis.plot(steps, edge, color=color, linestyle=style, linewidth=0.5, alpha=0.6)
            middle = np.median(relative_thrust, 0)
            axis.plot(steps, middle, color=color, linestyle=style, linewidth=width, label=label)
        axis.axhline(
            100.0 * goal,
            color="0.45",
            linewidth=0.7,
            linestyle="--",
            label=f"{100.0 * goal:.0f} %",
        )
        axis.set_xscale("log")
        axis.set_xlim(_FIRST, steps_shown)
        ticks = [tick for tick in _TICKS if _FIRST <= tick <= steps_shown]
        axis.set_xticks(ticks, [f"{tick:,}".replace(",", " ") for tick in ticks])
        axis.minorticks_off()
        axis.set_ylim(_LOWEST, 101)
        axis.set_xlabel("control steps")
        axis.set_ylabel(f"relative thrust (%, from {_LOWEST} % up)")
        figure.legend(loc="outside lower center", ncols=3)
