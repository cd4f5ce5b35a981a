"""The folder of a search: a table of its candidates, a recording of all, and a picture."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np

from fishd.core.errors import ConfigError
from fishd.lab.drawing import BLUE, ORANGE, drawn, save
from fishd.lab.optimise.search import Proposal, Search
from fishd.lab.optimise.trials import Trial
from fishd.lab.rig import Rig
from fishd.lab.rig_recording import recorded
from fishd.lab.tables import Table
from fishd.recording.writer import RunWriter

TRIALS, RECORDING = "trials.csv", "search.mcap"
_TICKS = [base * 10.0**k for k in range(-4, 4) for base in (1, 2, 3, 5)]
_COLUMNS = ("thrust", "error", "swum", "passed")


class SearchFolder:
    """A new folder in which candidates are kept as they are measured."""

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        """
        names: the parameters that are searched

        Raises `ConfigError` where there is something in the folder.
        """
        self.path = path
        try:
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise ConfigError(f"{path} exists already; give another --folder")
            path.mkdir(parents=True, exist_ok=True)
            self._table = Table(path / TRIALS, (*names, *_COLUMNS))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be made: {error.strerror}") from None

    def recorded(self, rig: Rig) -> AbstractContextManager[RunWriter]:
        """While this lasts, all that the rig does is recorded: `fishd.lab.rig_recording`."""
        return recorded(rig, self.path / RECORDING, "a search")

    def keep(self, trial: Trial) -> None:
        """Keep a candidate; raises `ConfigError`."""
        values = {name: getattr(trial, name) for name in _COLUMNS}
        try:
            self._table.add({**trial.parameters, **values})
        except OSError as error:
            raise ConfigError(
                f"{self.path / TRIALS}: cannot be written: {error.strerror}; what was measured "
                "before is in it"
            ) from None


def draw(
    folder: Path, search: Search, found: Proposal, units: Mapping[str, str], force_unit: str
) -> list[Path]:
    """The candidates over each parameter, and what is expected of one; PNG and SVG.

    Raises `FishdError` where a file cannot be written.
    """
    names = [each.name for each in search.ranges]
    paths = [folder / "thrust.png", folder / "thrust.svg"]
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
        axes[0].set_ylabel(f"thrust (m{force_unit})")
        axes[-1].legend()
        save(figure, paths[1])
    return paths
