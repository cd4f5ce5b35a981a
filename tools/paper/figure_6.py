"""Figure 6: the speed of the free swimmer against frequency, also on finer grids.

Each swim is stored when it ends, and stored swims are not computed again: `make figures` resumes
after an interruption. On one core that does nothing else, the swims on cells of 0.5 mm take 50
minutes, the eight on cells of 0.25 mm another 100.

Pale bars are the error by the grid, where a gait swims on several: on the left that of both grids,
on the right that of the finest. For the other points it is not known.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import joblib

from common.report import progress
from fishd.config import Config, load
from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, GREEN, ORANGE, PURPLE
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import SpeedResult
from fishd.lab.swimmer.refinement import GridSpeed, estimate
from fishd.lab.swimmer.speed import swim_freely
from paper.runs import FOLDER, Row, column, read, write

NAME = "figure-6"
WAVES = ("square", "sine", "triangle")
FREQUENCIES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
CRITERIA = (0.0, 0.6)
TICK = 0.002
"""Shortest tick of fishd, so that reversals are hardly delayed [s]."""
STEPS = {1.0: 0.5, 0.5: 0.4, 0.25: 0.2}
"""Time step [ms] for each size of the cells [mm]."""
NOT_STEADY = "never"
"""Text for a speed that still changed at the end."""
CONFIG = Path(__file__).resolve().parents[2] / "config" / "swimmer-undamped.yaml"


class Case(NamedTuple):
    """Case of one swim."""

    controller: str
    setting: float
    """Frequency of a wave [Hz], or C."""
    cell: float
    """Size of the cells [mm]."""

    def point(self) -> Point:
        """Return the controller with its parameter."""
        name = "C" if self.controller == "swing" else "frequency"
        return Point(self.controller, {name: self.setting})


REFINED = (("square", 3.0), ("sine", 2.0), ("swing", 0.6))
"""Controllers and settings that swim on all grids."""
FINE_SWIMS = (("square", 4.0), ("sine", 3.0), ("swing", 0.0), ("square", 1.5), ("sine", 1.5))
"""Controllers and settings that swim on the grid of the figure and the finest."""
LOST_SWIMS = (Case("square", 6.0, 0.5),)
"""Swims in which the fish turns and leaves the part with small cells before its speed is steady."""


class Table(NamedTuple):
    """Table of stored swims."""

    name: str
    cell: float
    """Size of the cells of the figure [mm]."""
    cells: tuple[float, ...]
    """Sizes of the cells of the refinement [mm]."""

    def curves(self) -> list[Case]:
        """Return the swims of the left panel."""
        waves = [Case(wave, frequency, self.cell) for wave in WAVES for frequency in FREQUENCIES]
        swings = [Case("swing", criterion, self.cell) for criterion in CRITERIA]
        return [case for case in waves + swings if case not in LOST_SWIMS]

    def cases(self) -> list[Case]:
        """Return every swim of the table."""
        others = [cell for cell in self.cells if cell != self.cell]
        refined = [Case(*swim, cell) for cell in others for swim in REFINED]
        return self.curves() + refined + [Case(*swim, min(self.cells)) for swim in FINE_SWIMS]

    def row(self, case: Case) -> dict[str, Any] | None:
        """Return the row of a swim; None before it is stored."""
        if not (FOLDER / f"{self.name}.csv").exists():
            return None
        having = {"controller": case.controller, "setting": case.setting, "cell_mm": case.cell}
        return next(iter(read(self.name, **having)), None)

    def grid_error(self, controller: str, setting: float, cell: float) -> float | None:
        """Return the half-width of a speed's error by the grid [mm/s]; None if not known."""
        rows = [self.row(Case(controller, setting, size)) for size in self.cells]
        grids = [
            GridSpeed(cell=row["cell_mm"], step=math.nan, speed=row["speed_mm_per_s"])
            for row in rows
            if row
        ]
        return estimate(grids).error(cell) if len(grids) > 1 else None


TABLE = Table(NAME, 0.5, (1.0, 0.5, 0.25))


def config(cell: float) -> Config:
    """Return the undamped swimmer on such a grid; cell: size of the cells [mm]"""
    numerics = "swimmer.numerics."
    step = 1e-3 * STEPS[cell]
    return load(
        CONFIG, (f"tick={TICK}", f"{numerics}cell={1e-3 * cell}", f"{numerics}step={step:g}")
    )


def swim(case: Case) -> tuple[Case, SpeedResult]:
    """Run a swim as `fishctl sweep` does; return it with its case."""
    fish = config(case.cell)
    result = swim_freely(case.point(), fish, Lengths.of(fish, None, None), None)
    assert result
    return case, result


def compute(jobs: int) -> None:
    """Compute every swim that is not in the table; each is stored when it ends.

    Raise SystemExit after the last one if the simulation diverged in any.
    """
    cases = TABLE.cases()
    rows = {case: row for case in cases if (row := TABLE.row(case))}
    missing = sorted((case for case in cases if case not in rows), key=_order)
    problems = []
    parallel = joblib.Parallel(jobs, batch_size=1, return_as="generator_unordered")
    for case, result in parallel(joblib.delayed(swim)(case) for case in missing):
        if result.failure:
            problems.append(f"{case}: {result.failure}")
            continue
        rows[case] = _row(case, result)
        progress(TABLE.name, f"{case}", f"{1e3 * (result.speed or 0.0):.2f} mm/s")
        write(TABLE.name, [rows[each] for each in cases if each in rows])
    if problems:
        raise SystemExit("\n".join(problems))


def _order(case: Case) -> tuple[Any, ...]:
    """Return a key that puts the swims of the left panel first, and the longest last."""
    last = case.controller == "triangle"
    return case.cell != TABLE.cell, -case.cell, last, case.controller == "swing", case.setting


def _row(case: Case, result: SpeedResult) -> Row:
    return {
        "controller": case.controller,
        "setting": case.setting,
        "cell_mm": case.cell,
        "frequency_Hz": result.beat_frequency,
        "speed_mm_per_s": 1e3 * (result.speed or 0.0),
        "ci95_mm_per_s": 1e3 * (result.speed_ci95 or 0.0),
        "beats": result.beats,
        "steady_from_s": NOT_STEADY if result.settled_time is None else result.settled_time,
        "seconds": result.seconds,
        "tail_side_to_side_over_L": result.tail_width or 0.0,
        "muscle_power_W_per_m": result.muscle_power or 0.0,
        "cost_of_transport_J_per_kg_m": result.cost_of_transport or "",
        "Strouhal": result.strouhal or "",
        "Froude_efficiency": result.froude_efficiency or "",
    }


def draw() -> None:
    """Draw speeds over frequencies on the left, over the size of the cells on the right."""
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (8.4, 3.9)) as figure:
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
        styles = zip(WAVES, (BLACK, BLUE, ORANGE), "so^", strict=True)
        colours = {}
        for wave, colour, marker in styles:
            rows = read(TABLE.name, controller=wave, cell_mm=TABLE.cell)
            colours[wave] = colour, marker
            _bars(left, rows, "setting", colour, marker, wave, "-")
        for criterion, marker, colour in zip(CRITERIA, "vD", (PURPLE, GREEN), strict=True):
            rows = read(TABLE.name, controller="swing", setting=criterion, cell_mm=TABLE.cell)
            colours["swing"] = colour, marker
            _bars(left, rows, "frequency_Hz", colour, marker, f"swing, C = {criterion:g}", "")
        for (controller, setting), line in zip(REFINED, ("-", (0, (5, 2)), ":"), strict=True):
            rows = read(TABLE.name, controller=controller, setting=setting)
            rows.sort(key=lambda row: float(row["cell_mm"]))
            what = f"C = {setting:g}" if controller == "swing" else f"{setting:g} Hz"
            colour, marker = colours[controller]
            _bars(right, rows, "cell_mm", colour, marker, f"{controller}, {what}", line)
            finest = Case(controller, setting, rows[0]["cell_mm"])
            _draw_grid_error(right, finest, "cell_mm", colour)
        for controller, setting in REFINED + FINE_SWIMS:
            colour = PURPLE if (controller, setting) == ("swing", 0.0) else colours[controller][0]
            case, finest = (
                Case(controller, setting, cell) for cell in (TABLE.cell, min(TABLE.cells))
            )
            _draw_grid_error(left, case, "frequency_Hz", colour)
            _draw_grid_error(left, finest, "frequency_Hz", colour)
            if row := TABLE.row(finest):
                place = row["frequency_Hz"], row["speed_mm_per_s"]
                left.plot(*place, ls="", marker="x", color=colour, zorder=6)
        left.plot([], [], ls="", marker="x", color="0.4", label=f"cells of {min(TABLE.cells)} mm")
        for axes in (left, right):
            axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
            axes.legend()
        left.set_xlabel("frequency (Hz)")
        left.set_ylabel("speed (mm/s)")
        left.set_xlim(0.0, 6.3)
        right.set_xlabel("size of the cells (mm)")
        right.set_xlim(0.0, 1.1 * max(TABLE.cells))


def _draw_grid_error(axes: Any, case: Case, over: str, colour: str) -> None:
    row, error = TABLE.row(case), TABLE.grid_error(*case)
    if row and error is not None:
        axes.errorbar(
            row[over], row["speed_mm_per_s"], yerr=error, color=colour, ls="",
            elinewidth=5, alpha=0.25, zorder=1,
        )  # fmt: skip


def _bars(
    axes: Any,
    rows: list[dict[str, Any]],
    over: str,
    colour: str,
    marker: str,
    label: str,
    line: Any,
) -> None:
    """Draw intervals without a line, hollow where the speed still changed."""
    axes.errorbar(
        column(rows, over),
        column(rows, "speed_mm_per_s"),
        yerr=column(rows, "ci95_mm_per_s"),
        color=colour, marker=marker, mfc=colour if line else "white", ls=line, lw=1.0,
        elinewidth=0.9, capsize=2, label=label,
    )  # fmt: skip
    changing = [row for row in rows if row["steady_from_s"] == NOT_STEADY]
    axes.plot(
        column(changing, over), column(changing, "speed_mm_per_s"), ls="", marker=marker,
        color=colour, mfc="white", zorder=5,
    )  # fmt: skip


def fastest() -> Iterator[tuple[float, str, list[str]]]:
    """Yield for each frequency the fastest wave, and those equally fast within the intervals.

    Frequencies without a speed of the square wave are left out.
    """
    for frequency in FREQUENCIES:
        rows = {wave: TABLE.row(Case(wave, frequency, TABLE.cell)) for wave in WAVES}
        speeds = {
            wave: (row["speed_mm_per_s"], row["ci95_mm_per_s"]) for wave, row in rows.items() if row
        }
        if "square" not in speeds:
            continue
        first = max(speeds, key=lambda wave: speeds[wave][0])
        top, error = speeds[first]
        alike = [
            wave
            for wave, (speed, other) in speeds.items()
            if wave != first and top - speed <= (error**2 + other**2) ** 0.5
        ]
        yield frequency, first, alike
