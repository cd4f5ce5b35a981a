"""The picture of a search: its candidates over each parameter, and what is expected of one."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fishd.lab.drawing import BLUE, ORANGE, drawn, save
from fishd.lab.optimise.search import Proposal, Search

_TICKS = [base * 10.0**k for k in range(-4, 4) for base in (1, 2, 3, 5)]


def draw(
    paths: Sequence[Path], search: Search, found: Proposal, units: Mapping[str, str], label: str
) -> None:
    """Draw the candidates over each parameter into files; the suffix chooses the format.

    label: of the objective, in thousandths of its unit

    Raises `FishdError` where a file cannot be written.
    """
    names = [each.name for each in search.ranges]
    with drawn(paths[0], (3.6 * len(names) + 2.4, 3.8)) as figure:
        axes = figure.subplots(1, len(names), squeeze=False)[0]
        for axis, each in zip(axes, search.ranges, strict=True):
            x, y, error = search.measured(each.name)
            if len(names) == 1:
                values, mean, half = search.curve()
                axis.fill_between(
                    values, 1e3 * (mean - half), 1e3 * (mean + half), color=BLUE, alpha=0.15,
                    linewidth=0.0, label="expected, 95 %",
                )  # fmt: skip
                axis.plot(values, 1e3 * mean, color=BLUE, linewidth=1.0)
            axis.errorbar(
                x, 1e3 * np.array(y), yerr=1e3 * np.array(error), fmt="o", color=ORANGE,
                markersize=4, elinewidth=0.8, capsize=2, label="candidates, 95 %",
            )  # fmt: skip
            best = found.parameters[each.name]
            axis.axvspan(found.low[each.name], found.high[each.name], color="0.85", zorder=0)
            axis.axvline(best, color="0.2", linewidth=0.8, label="best, 95 %")
            if each.is_logarithmic:
                axis.set_xscale("log")
                ticks = [at for at in _TICKS if each.low <= at <= each.high]
                axis.set_xticks(ticks, [f"{at:g}" for at in ticks])
                axis.xaxis.set_minor_formatter("")
            unit = units.get(each.name, "")
            axis.set_xlabel(f"{each.name} ({unit})" if unit not in ("", "1") else each.name)
        axes[0].set_ylabel(label)
        axes[-1].legend()
        for path in paths[1:]:
            save(figure, path)
