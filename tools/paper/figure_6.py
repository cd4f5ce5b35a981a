"""Figure 6: the speed of free swimmers against frequency on cells of 0.5 mm, some also on others.

Each swim is stored when it ends, and stored swims are not computed again: `make figures` resumes
after an interruption. A swim of 18 s takes some two minutes of one core on cells of 0.5 mm, and 12
on cells of 0.25 mm. A swim that never gets steady is swum from three starts.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import joblib
from msgspec.structs import replace

from common.report import progress
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.lab import drawing
from fishd.lab.drawing import BLACK, BLUE, GREEN, ORANGE, PURPLE
from fishd.lab.simulation import VirtualRun
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import SpeedResult
from fishd.lab.swimmer.refinement import GridSpeed, estimate
from fishd.lab.swimmer.speed import swim_freely
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
    """C of the swings."""
    waves: tuple[str, ...] = WAVES
    fine: tuple[tuple[str, float], ...] = ()
    """Controllers and settings that also swim on coarser and finer cells."""
    lost: tuple[tuple[str, float], ...] = ()
    """Swims in which the fish turns and leaves the part with small cells before its speed is
    steady."""


READINGS = {
    "damped": Reading(
        "swimmer.yaml",
        (),
        (0.0, 0.6),
        fine=(("swing", 0.0), *((wave, f) for wave in WAVES for f in (2.0, 1.5, 3.0))),
    ),
    "undamped": Reading(
        "swimmer-undamped.yaml",
        (),
        (0.0, 0.6),
        fine=(("square", 3.0), ("sine", 3.0)),
        lost=(("square", 6.0),),
    ),
    "damped, servo": Reading("swimmer.yaml", ("swimmer.muscle.servo=true",), (0.0,)),
    "damped, angle": Reading("swimmer.yaml", ("estimator.kind=sensor",), (0.0, 0.6), waves=()),
}
"""The readings, by the name in the table.

damped: ω₀ and ξ of the robot, which the paper says that its body has
undamped: the Young's modulus and the viscosity that it prints
damped, servo: the first with the delay of the robot's servo
damped, angle: the first, its swing by the rate of the tail's angle against the front body
"""


class Case(NamedTuple):
    """Case of one swim."""

    fish: str
    """Name of a reading."""
    controller: str
    setting: float
    """Frequency of a wave [Hz], or C."""
    cell: float
    """Size of the cells [mm]."""
    start: int = 1
    """1 from rest; 2 and 3 after 0.6 and 1.2 s of a sine wave of 2.7 Hz."""

    def point(self) -> Point:
        """Return the controller with its parameter."""
        name = "C" if self.controller == "swing" else "frequency"
        return Point(self.controller, {name: self.setting})

    def begin(self, run: VirtualRun) -> None:
        """Swim what comes before another start than that from rest."""
        limits = replace(run.config.limits, virtual=True)
        run.loop.set_controller("sine", registry.create("sine", {"frequency": 2.7}, limits))
        for _ in range(round((self.start - 1) * 0.6 / TICK)):
            run.tick()

    def row(self) -> dict[str, Any] | None:
        """Return the row of this swim; None before it is stored."""
        if not (FOLDER / f"{NAME}.csv").exists():
            return None
        having = dict(zip(KEYS, self, strict=True))
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


KEYS = ("fish", "controller", "setting", "cell_mm", "start")
"""Columns of the table that name a case."""


def curves(fish: str) -> list[Case]:
    """Return the swims of one fish on the cells of the figure."""
    reading = READINGS[fish]
    swims = [(wave, frequency) for wave in reading.waves for frequency in FREQUENCIES]
    swims += [("swing", criterion) for criterion in reading.criteria]
    return [Case(fish, *swim, CELL) for swim in swims if swim not in reading.lost]


def cases() -> list[Case]:
    """Return every swim of the table."""
    chosen = [case for fish in READINGS for case in curves(fish)]
    refined = [(f, swim) for f, reading in READINGS.items() for swim in reading.fine]
    return chosen + [Case(f, *swim, cell) for f, swim in refined for cell in STEPS if cell != CELL]


def other_starts() -> list[Case]:
    """Return two more starts of each swim on the cells of the figure that never got steady.

    Only readings that also swim on the finest grid are repeated.
    """
    swum = {
        case: case.row()
        for fish, reading in READINGS.items()
        if reading.fine
        for case in curves(fish)
    }
    restless = [case for case, row in swum.items() if row and row["steady_from_s"] == NOT_STEADY]
    return [case._replace(start=start) for case in restless for start in (2, 3)]


def config(fish: str, cell: float) -> Config:
    """Return a fish on such a grid; cell: size of the cells [mm]"""
    numerics, reading = "swimmer.numerics.", READINGS[fish]
    keys = (f"{numerics}cell={1e-3 * cell}", f"{numerics}step={1e-3 * STEPS[cell]:g}")
    return load(CONFIGS / reading.file, (f"tick={TICK}", *keys, *reading.overrides))


def swim(case: Case) -> tuple[Case, SpeedResult]:
    """Run a swim as `fishctl sweep` does; return it with its case."""
    fish = config(case.fish, case.cell)
    lengths = Lengths.of(fish, None, None)
    result = swim_freely(case.point(), fish, lengths, None, on_start=case.begin)
    assert result
    return case, result


def compute(jobs: int) -> None:
    """Compute every swim that is not in the table; each is stored when it ends.

    Raise SystemExit after the last one if the simulation diverged in any.
    """
    problems = []
    for chosen in (cases, other_starts):
        rows = {case: row for case in (*cases(), *other_starts()) if (row := case.row())}
        missing = sorted((case for case in chosen() if case not in rows), key=_order)
        parallel = joblib.Parallel(jobs, batch_size=1, return_as="generator_unordered")
        for case, result in parallel(joblib.delayed(swim)(case) for case in missing):
            if result.failure:
                problems.append(f"{case}: {result.failure}")
                continue
            rows[case] = _row(case, result)
            progress(NAME, f"{case}", f"{1e3 * (result.speed or 0.0):.2f} mm/s")
            write(NAME, sorted(rows.values(), key=_place))
    if problems:
        raise SystemExit("\n".join(problems))


def _order(case: Case) -> tuple[Any, ...]:
    """Return a key that puts large cells and the first fish first."""
    last = case.controller == "triangle"
    return case.cell != CELL, list(READINGS).index(case.fish), last, case.setting


def _place(row: Row) -> tuple[Any, ...]:
    """Return a key for the rows of the table."""
    names = "controller", "setting", "start"
    controller, setting, start = (row[name] for name in names)
    swims = [*WAVES, "swing"]
    fish = list(READINGS).index(str(row["fish"]))
    return fish, -float(row["cell_mm"]), swims.index(str(controller)), setting, start


def _row(case: Case, result: SpeedResult) -> Row:
    return {
        **dict(zip(KEYS, case, strict=True)),
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
    """Draw speeds over frequencies, a panel for each fish that swims the waves."""
    panels = [fish for fish, reading in READINGS.items() if reading.waves]
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (8.4, 3.6)) as figure:
        all_axes = figure.subplots(1, len(panels), sharey=True)
        for axes, fish in zip(all_axes, panels, strict=True):
            axes.axhline(0.0, color="0.85", linewidth=0.6, zorder=0)
            for wave, colour, marker in zip(WAVES, (BLACK, BLUE, ORANGE), "so^", strict=True):
                having = {"fish": fish, "controller": wave}
                _draw(axes, having, "setting", colour, marker, wave, "-")
            for criterion, colour, marker in zip((0.0, 0.6), (PURPLE, GREEN), "vD", strict=True):
                having = {"fish": fish, "controller": "swing", "setting": criterion}
                _draw(axes, having, "frequency_Hz", colour, marker, f"swing, C = {criterion:g}", "")
            axes.plot([], [], ls="", marker="x", color="0.4", label=f"cells of {FINE_CELL} mm")
            axes.set_title(fish)
            axes.set_xlabel("frequency (Hz)")
            axes.set_xlim(0.0, 6.3)
        all_axes[0].set_ylabel("speed (mm/s)")
        all_axes[-1].legend(*all_axes[0].get_legend_handles_labels())


def _draw(
    axes: Any,
    having: dict[str, Any],
    over: str,
    colour: str,
    marker: str,
    label: str,
    line: str,
) -> None:
    """Draw the swims of a curve: intervals, hollow points for speeds that still changed at the end,
    crosses for the finest grid, pale bars for the error by the grid."""
    rows = read(NAME, cell_mm=CELL, start=1.0, **having)
    if not rows:
        return
    axes.errorbar(
        column(rows, over), column(rows, "speed_mm_per_s"), yerr=column(rows, "ci95_mm_per_s"),
        color=colour, marker=marker, ms=4, ls=line, lw=1.0, elinewidth=0.9, capsize=2, label=label,
    )  # fmt: skip
    changing = read(NAME, cell_mm=CELL, steady_from_s=NOT_STEADY, **having)
    fine = read(NAME, cell_mm=FINE_CELL, **having)
    for some, shape, fill in ((changing, marker, "white"), (fine, "x", colour)):
        places = column(some, over), column(some, "speed_mm_per_s")
        axes.plot(*places, ls="", marker=shape, ms=4, color=colour, mfc=fill, zorder=6)
    for row in (*rows, *fine):
        case = Case(*(row[key] for key in KEYS))
        if (error := case.grid_error()) is not None:
            axes.errorbar(
                row[over], row["speed_mm_per_s"], yerr=error, color=colour, ls="",
                elinewidth=5, alpha=0.25, zorder=1,
            )  # fmt: skip


def speeds(fish: str, frequency: float, cell: float = CELL) -> dict[str, tuple[float, float]]:
    """Return speed and half-width of its interval [mm/s] of the waves that swam, the fastest first.

    Where a speed never got steady, it is the mean of all starts, with half of their range as the
    half-width if that is more.
    """
    swum = {}
    for wave in WAVES:
        first = Case(fish, wave, frequency, cell)
        starts = [row for start in (1, 2, 3) if (row := first._replace(start=start).row())]
        if starts:
            values = column(starts, "speed_mm_per_s")
            half_range = 0.5 * (max(values) - min(values))
            half_width = max(half_range, starts[0]["ci95_mm_per_s"])
            swum[wave] = sum(values) / len(values), half_width
    return dict(sorted(swum.items(), key=lambda item: -item[1][0]))


def margin(fish: str, frequency: float, cell: float = CELL) -> float | None:
    """Return how much faster the square wave is than the fastest other one, as a fraction of that.

    None where the square wave, or both others, did not swim.
    """
    swum = speeds(fish, frequency, cell)
    square = swum.pop("square", None)
    if square is None or not swum:
        return None
    return square[0] / max(speed for speed, _ in swum.values()) - 1.0
