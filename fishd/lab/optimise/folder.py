"""The folder of a search: a table of its candidates, a recording of all, and a picture."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from fishd import __version__
from fishd.core.errors import ConfigError, FishdError
from fishd.core.files import FileProblem, write_atomically
from fishd.lab import tables
from fishd.lab.begun import begin
from fishd.lab.drawing import BLUE, ORANGE, drawn, save
from fishd.lab.optimise.search import Proposal, Search
from fishd.lab.optimise.trials import Trial
from fishd.lab.rig import Rig
from fishd.lab.rig_recording import recorded
from fishd.lab.tables import Table
from fishd.recording.part_file import PART
from fishd.recording.writer import RunWriter

BEGUN, TRIALS, RECORDING = "search.json", "trials.csv", "search.mcap"
_TICKS = [base * 10.0**k for k in range(-4, 4) for base in (1, 2, 3, 5)]
_COLUMNS = ("thrust", "error", "power", "power_error", "swum", "passed")


class Begun(Struct, frozen=True):
    """With what a search began; a folder is resumed only with the same."""

    on: str
    controller: str
    parameters: dict[str, Any]
    """Those that are not searched."""
    over: dict[str, tuple[float, float]]
    """From where to where each other one is."""
    seed: int
    config: dict[str, Any]
    """The fish, as plain data."""
    force_unit: str = "N"
    objective: str = "thrust"
    target: float | None = None
    """The thrust that was to be reached, where the least power was searched [N]."""
    version: str = __version__


class SearchFolder:
    """A folder in which candidates are kept as they are measured.

    `done` has those that were there when it was opened.
    """

    def __init__(self, path: Path, begun: Begun) -> None:
        """Makes the folder, or resumes one; raises `ConfigError` if that began with another."""
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            begin(path / BEGUN, begun, "search")
            head = (*begun.over, *_COLUMNS)
            self.done = _read(path / TRIALS, head)
            self._table = Table(path / TRIALS, head)
        except OSError as error:
            raise self._unwritable(error) from None

    def recorded(self, rig: Rig) -> AbstractContextManager[RunWriter]:
        """While this lasts, all that the rig does goes into a recording of its own."""
        first, number = self.path / RECORDING, 1
        path = first
        while path.exists() or path.with_name(path.name + PART).exists():
            number += 1
            path = first.with_stem(f"{first.stem}-{number}")
        return recorded(rig, path, "a search")

    def keep(self, trial: Trial) -> None:
        """Keep a candidate; raises `FishdError`."""
        values = {name: getattr(trial, name) for name in _COLUMNS}
        try:
            self._table.add({**trial.parameters, **values})
        except OSError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: OSError) -> FishdError:
        where = error.filename or self.path
        return FishdError(
            f"{where}: cannot be written: {error.strerror}; what was measured before is kept"
        )


def _read(path: Path, head: tuple[str, ...]) -> list[Trial]:
    """The candidates of a table; a last row that a kill has cut off is dropped."""
    if not path.exists():
        return []
    try:
        before, *rows = tables.read(path)
        if tuple(before) != head:
            raise ValueError
        if not path.read_bytes().endswith(b"\n"):
            write_atomically(path, tables.lines([head, *rows]))
        found = [dict(zip(head, map(float, row), strict=True)) for row in rows]
    except FileProblem as problem:
        raise ConfigError(f"{path}: {problem}") from None
    except ValueError:
        raise ConfigError(f"{path}: not the table of this search; give another --folder") from None
    names = head[: -len(_COLUMNS)]
    return [
        Trial(
            {name: row[name] for name in names},
            row["thrust"],
            row["error"],
            row["power"],
            row["power_error"],
            int(row["swum"]),
            row["passed"],
        )
        for row in found
    ]


def draw(
    folder: Path, search: Search, found: Proposal, units: Mapping[str, str], label: str
) -> list[Path]:
    """The candidates over each parameter, and what is expected of one; PNG and SVG.

    label: of the objective, in thousandths of its unit

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
        axes[0].set_ylabel(label)
        axes[-1].legend()
        save(figure, paths[1])
    return paths
