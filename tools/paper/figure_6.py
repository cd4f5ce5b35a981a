"""Figure 6: the speed of free swimmers against frequency, also on finer grids.

Each swim is stored when it ends, and stored swims are not computed again: `make figures` resumes
after an interruption. On one core that does nothing else, the swims of one fish on cells of 0.5 mm
take an hour or two, each on cells of 0.25 mm some 15 minutes.

Crosses are swims on cells of 0.25 mm. Pale bars are the error by the grid, where it is known.
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
from fishd.lab.sweep.grid import Point
from fishd.lab.sweep.measuring import Lengths, swim_freely
from fishd.lab.sweep.results import SpeedResult
from fishd.lab.swimmer.refinement import GridSpeed, estimate
from paper.runs import FOLDER, Row, column, read, write

NAME = "figure-6"
WAVES = ("square", "sine", "triangle")
FREQUENCIES = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
TICK = 0.002
"""Shortest tick of fishd, so that reversals are hardly delayed [s]."""
CELL, FINE_CELL = 0.5, 0.25
"""Sizes of the cells of the figure, and of its crosses [mm]."""
STEPS = {1.0: 0.5, CELL: 0.4, FINE_CELL: 0.2}
"""Time step [ms] for each size of the cells [mm]."""
NOT_STEADY = "never"
"""Text for a speed that still changed at the end."""
CONFIGS = Path(__file__).resolve().parents[2] / "config"


class Reading(NamedTuple):
    """One reading of what the paper says of its fish."""

    file: str
    """Configuration in config/."""
    overrides: tuple[str, ...]
    criteria: tuple[float, ...]
    """C of the swings of the figure."""
    fine: tuple[tuple[str, float], ...]
    """Controllers and settings that also swim on the finest grid."""
    coarse: tuple[tuple[str, float], ...] = ()
    """Controllers and settings that swim on cells of 1 mm, too."""
    lost: tuple[tuple[str, float], ...] = ()
    """Swims in which the fish turns and leaves the part with small cells before its speed is
    steady."""


READINGS = {
    "damped": Reading(
        "swimmer.yaml",
        (),
        (0.0, 0.6),
        (*((wave, f) for f in (1.5, 2.0, 3.0) for wave in ("square", "sine")), ("swing", 0.0)),
    ),
    "undamped": Reading(
        "swimmer-undamped.yaml",
        (),
        (0.0, 0.6),
        (
            *(("square", 3.0), ("sine", 2.0), ("swing", 0.6), ("square", 4.0), ("sine", 3.0)),
            *(("swing", 0.0), ("square", 1.5), ("sine", 1.5)),
        ),
        (("square", 3.0), ("sine", 2.0), ("swing", 0.6)),
        (("square", 6.0),),
    ),
    "damped, with a servo": Reading("swimmer.yaml", ("swimmer.muscle.servo=true",), (0.0,), ()),
}
"""The readings, by the name in the table: ω₀ and ξ of the robot, which the paper says that its body
has; the Young's modulus and viscosity that it prints; and the first with the delay of the servo."""


class Case(NamedTuple):
    """Case of one swim."""

    fish: str
    """Name of a reading."""
    controller: str
    setting: float
    """Frequency of a wave [Hz], or C."""
    cell: float
    """Size of the cells [mm]."""

    def point(self) -> Point:
        """Return the controller with its parameter."""
        name = "C" if self.controller == "swing" else "frequency"
        return Point(self.controller, {name: self.setting})

    def row(self) -> dict[str, Any] | None:
        """Return the row of this swim; None before it is stored."""
        if not (FOLDER / f"{NAME}.csv").exists():
            return None
        having = dict(zip(_KEYS, self, strict=True))
        return next(iter(read(NAME, **having)), None)

    def grid_error(self) -> float | None:
        """Return the half-width of the speed's error by the grid [mm/s]; None if not known."""
        rows = [self._replace(cell=cell).row() for cell in STEPS]
        grids = [
            GridSpeed(cell=row["cell_mm"], step=math.nan, speed=row["speed_mm_per_s"])
            for row in rows
            if row
        ]
        return estimate(grids).error(self.cell) if len(grids) > 1 else None


_KEYS = ("fish", "controller", "setting", "cell_mm")


def curves(fish: str) -> list[Case]:
    """Return the swims of one fish on the cells of the figure."""
    reading = READINGS[fish]
    swims = [(wave, frequency) for wave in WAVES for frequency in FREQUENCIES]
    swims += [("swing", criterion) for criterion in reading.criteria]
    return [Case(fish, *swim, CELL) for swim in swims if swim not in reading.lost]


def cases() -> list[Case]:
    """Return every swim of the table."""
    chosen = [case for fish in READINGS for case in curves(fish)]
    chosen += [Case(f, *swim, 1.0) for f, reading in READINGS.items() for swim in reading.coarse]
    fine = [(f, swim) for f, reading in READINGS.items() for swim in reading.fine]
    return chosen + [Case(fish, *swim, FINE_CELL) for fish, swim in fine]


def config(fish: str, cell: float) -> Config:
    """Return a fish on such a grid; cell: size of the cells [mm]"""
    numerics, reading = "swimmer.numerics.", READINGS[fish]
    keys = (f"{numerics}cell={1e-3 * cell}", f"{numerics}step={1e-3 * STEPS[cell]:g}")
    return load(CONFIGS / reading.file, (f"tick={TICK}", *keys, *reading.overrides))


def swim(case: Case) -> tuple[Case, SpeedResult]:
    """Run a swim as `fishctl sweep` does; return it with its case."""
    fish = config(case.fish, case.cell)
    result = swim_freely(case.point(), fish, Lengths.of(fish, None, None), None)
    assert result
    return case, result


def compute(jobs: int) -> None:
    """Compute every swim that is not in the table; each is stored when it ends.

    Raise SystemExit after the last one if the simulation diverged in any.
    """
    rows = {case: row for case in cases() if (row := case.row())}
    missing = sorted((case for case in cases() if case not in rows), key=_order)
    problems = []
    parallel = joblib.Parallel(jobs, batch_size=1, return_as="generator_unordered")
    for case, result in parallel(joblib.delayed(swim)(case) for case in missing):
        if result.failure:
            problems.append(f"{case}: {result.failure}")
            continue
        rows[case] = _row(case, result)
        progress(NAME, f"{case}", f"{1e3 * (result.speed or 0.0):.2f} mm/s")
        write(NAME, [rows[each] for each in cases() if each in rows])
    if problems:
        raise SystemExit("\n".join(problems))


def _order(case: Case) -> tuple[Any, ...]:
    """Return a key that puts the swims of the first fish first, and the longest last."""
    last = case.controller == "triangle"
    return case.cell != CELL, list(READINGS).index(case.fish), last, case.setting


def _row(case: Case, result: SpeedResult) -> Row:
    return {
        **dict(zip(_KEYS, case, strict=True)),
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
    """Draw speeds over frequencies, a panel for each fish."""
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (8.4, 3.9)) as figure:
        panels = figure.subplots(1, len(READINGS), sharey=True)
        for axes, fish in zip(panels, READINGS, strict=True):
            styles = zip(WAVES, (BLACK, BLUE, ORANGE), "so^", strict=True)
            for wave, colour, marker in styles:
                rows = read(NAME, fish=fish, controller=wave, cell_mm=CELL)
                _bars(axes, rows, "setting", colour, marker, wave, "-")
                _draw_fine(axes, fish, wave, colour)
            for criterion, marker, colour in zip((0.0, 0.6), "vD", (PURPLE, GREEN), strict=True):
                having = {"controller": "swing", "setting": criterion, "cell_mm": CELL}
                rows = read(NAME, fish=fish, **having)
                if rows:
                    label = f"swing, C = {criterion:g}"
                    _bars(axes, rows, "frequency_Hz", colour, marker, label, "")
                _draw_fine(axes, fish, "swing", colour, criterion)
            axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
            axes.set_title(fish)
            axes.set_xlabel("frequency (Hz)")
            axes.set_xlim(0.0, 6.3)
        panels[0].plot([], [], ls="", marker="x", color="0.4", label=f"cells of {FINE_CELL} mm")
        panels[0].legend()
        panels[0].set_ylabel("speed (mm/s)")


def _draw_fine(
    axes: Any, fish: str, controller: str, colour: str, setting: float | None = None
) -> None:
    """Draw the swims on the finest grid, and the error by the grid of both."""
    for name, value in READINGS[fish].fine:
        if name != controller or setting not in (None, value):
            continue
        case = Case(fish, name, value, FINE_CELL)
        for each in (case, case._replace(cell=CELL)):
            row, error = each.row(), each.grid_error()
            if row and error is not None:
                axes.errorbar(
                    row["frequency_Hz"], row["speed_mm_per_s"], yerr=error, color=colour, ls="",
                    elinewidth=5, alpha=0.25, zorder=1,
                )  # fmt: skip
        if row := case.row():
            place = row["frequency_Hz"], row["speed_mm_per_s"]
            axes.plot(*place, ls="", marker="x", color=colour, zorder=6)


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


def fastest(fish: str) -> Iterator[tuple[float, str, list[str]]]:
    """Yield for each frequency the fastest wave, and those equally fast within the intervals.

    Frequencies without a speed of the square wave are left out.
    """
    for frequency in FREQUENCIES:
        rows = {wave: Case(fish, wave, frequency, CELL).row() for wave in WAVES}
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
