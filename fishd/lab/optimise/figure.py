"""Picture of a search: candidates over each parameter, and the prediction for a single one."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fishd.lab.drawing import BLUE, ORANGE, open_figure, save
from fishd.lab.optimise.search import Proposal, Search

_LOG_TICKS = [base * 10.0**k for k in range(-4, 4) for base in (1, 2, 3, 5)]


def draw(
    paths: Sequence[Path], search: Search, proposal: Proposal, units: Mapping[str, str], label: str
) -> None:
    """Draw the candidates over each parameter into files; the suffix chooses the format.

    label: name of the objective, in thousandths of its unit

    Raises `FishdError` if a file cannot be written.
    """
    names = [searched.name for searched in search.ranges]
    with open_figure(paths[0], (3.6 * len(names) + 2.4, 3.8)) as figure:
        axes = figure.subplots(1, len(names), squeeze=False)[0]
        for axis, searched in zip(axes, search.ranges, strict=True):
            x, y, error = search.read_measurements(searched.name)
            if len(names) == 1:
                values, mean, half_width = search.predict_curve()
                axis.fill_between(
                    values, 1e3 * (mean - half_width), 1e3 * (mean + half_width), color=BLUE,
                    alpha=0.15, linewidth=0.0, label="expected, 95 %",
                )  # fmt: skip
                axis.plot(values, 1e3 * mean, color=BLUE, linewidth=1.0)
            axis.errorbar(
                x, 1e3 * np.array(y), yerr=1e3 * np.array(error), fmt="o", color=ORANGE,
                markersize=4, elinewidth=0.8, capsize=2, label="candidates, 95 %",
            )  # fmt: skip
            best = proposal.parameters[searched.name]
            axis.axvspan(
                proposal.parameters_ci95_low[searched.name],
                proposal.parameters_ci95_high[searched.name],
                color="0.85",
                zorder=0,
            )
            axis.axvline(best, color="0.2", linewidth=0.8, label="best, 95 %")
            if searched.is_logarithmic:
                axis.set_xscale("log")
                ticks = [tick for tick in _LOG_TICKS if searched.low <= tick <= searched.high]
                axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
                axis.xaxis.set_minor_formatter("")
            unit = units.get(searched.name, "")
            axis.set_xlabel(f"{searched.name} ({unit})" if unit not in ("", "1") else searched.name)
        axes[0].set_ylabel(label)
        axes[-1].legend()
        for path in paths[1:]:
            save(figure, path)
