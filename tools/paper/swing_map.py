"""Thrust of `swing` relative to the best square wave in the loop, for each C and amplitude.

Each number is the median of several runs on a simulated fish with an imperfect force sensor; the
runs differ in the seed of noise and drift.
"""

import csv
import itertools

import msgspec
import numpy as np
from numpy.typing import NDArray

from common.report import DOCS, table
from fishd.config import Config
from fishd.lab import drawing
from fishd.lab.optimum import saturation_amplitude
from fishd.virtual.imperfections import SimulationSettings
from paper.runs import FOLDER, PERFECT, PLANT, Run, column, read, swim_all, write

NAME = "swing-map"
DOCUMENT = "explanation/swing-efficiency.md"
REFERENCE = DOCS.parent / "tests" / "reference" / "swing_efficiency.csv"

CRITERIA = tuple(tenths / 10 for tenths in range(11))
"""Values of C."""
RATIOS = (0.1, 0.25, 0.5, 0.9, 1.5, 2.0, 3.0)
"""Values of ω₀Φ/Ω."""
REAL = SimulationSettings(noise=0.001, offset_y=0.02, drift=0.02)
SEEDS = 10
SECONDS, SETTLE = 140.0, 20.0
"""Length of a run and of its ignored start [s]; the rest has two periods of the drift."""

RECOMMENDED, NEARLY_BEST = 0.6, 0.95
"""Claim of the paper: C = 0.6 gives over 95 % of the optimum for every ω₀Φ/Ω."""
ANY_UPTO, GOOD = 0.8, 0.7
"""Claim of the paper: any C in 0 … 0.8 gives over 70 %."""
CLAIMS = (
    f"C = {RECOMMENDED:g}: over {100 * NEARLY_BEST:g} % for every ω₀Φ/Ω",
    f"any C in 0 … {ANY_UPTO:g}: over {100 * GOOD:g} %",
)
_SHAPE = (len(CRITERIA), len(RATIOS))

Array = NDArray[np.float64]


def run(criterion: float, ratio: float, rig: SimulationSettings) -> Run:
    """Return a run of `swing` with ticks of 50 ms."""
    config = Config(amplitude_limit=ratio * saturation_amplitude(PLANT), simulation=rig)
    return Run("swing", {"C": criterion}, config, SECONDS, SETTLE)


def compute(jobs: int) -> None:
    """Compute the map of the imperfect rig, and of a perfect one."""
    rigs = [PERFECT, *(msgspec.structs.replace(REAL, seed=seed) for seed in range(SEEDS))]
    cells = list(itertools.product(CRITERIA, RATIOS))
    reports = swim_all((run(*cell, rig) for cell in cells for rig in rigs), jobs)
    relative_thrusts = np.array([report.relative_thrust for report in reports]).reshape(
        len(cells), len(rigs)
    )
    exact = continuous_time()
    write(
        NAME,
        [
            {
                "C": criterion,
                "w0Phi_over_Omega": ratio,
                "median": float(np.median(real)),
                "lowest": float(real.min()),
                "highest": float(real.max()),
                "perfect_sensor": float(perfect),
                "continuous_time": exact.get((criterion, ratio), ""),
            }
            for (criterion, ratio), (perfect, *_), real in zip(
                cells, relative_thrusts, relative_thrusts[:, 1:], strict=True
            )
        ],
    )


def continuous_time() -> dict[tuple[float, float], float]:
    """Return the relative thrust with the true fin velocity and no tick, by C and ω₀Φ/Ω."""
    with REFERENCE.open(newline="", encoding="utf-8") as file:
        return {
            (float(row["C"]), float(row["w0Phi_over_Omega"])): float(row["efficiency"])
            for row in csv.DictReader(file)
        }


def _map(name: str) -> Array:
    """Return a column of the table, shape (criteria, ratios); NaN where nothing was measured."""
    values = [np.nan if value == "" else value for value in column(read(NAME), name)]
    return np.array(values, dtype=np.float64).reshape(_SHAPE)


def draw() -> None:
    """Draw the map of medians."""
    from matplotlib.patches import Rectangle

    median = _map("median")
    with drawing.open_figure(FOLDER / f"{NAME}.svg", (8, 6)) as figure:
        axes = figure.subplots()
        axes.spines[:].set_visible(False)
        image = axes.pcolormesh(
            100 * median, cmap="cividis", vmin=50, vmax=100, edgecolor="white", lw=0.3
        )
        for (row, each), value in np.ndenumerate(median):
            colour = "black" if value > 0.75 else "white"
            weight = "bold" if value > NEARLY_BEST else "normal"
            text = axes.text(each + 0.5, row + 0.5, percent(value), color=colour, weight=weight)
            text.set(ha="center", va="center", fontsize=10)
        row = CRITERIA.index(RECOMMENDED)
        axes.add_patch(Rectangle((0.02, row + 0.02), len(RATIOS) - 0.04, 0.96, fill=False, lw=2))
        angles = [ratio * saturation_amplitude(PLANT) for ratio in RATIOS]
        labels = [f"{r:g}\n{angle:.3f}" for r, angle in zip(RATIOS, angles, strict=True)]
        axes.set_xticks(np.arange(len(RATIOS)) + 0.5, labels)
        axes.set_yticks(np.arange(len(CRITERIA)) + 0.5, [f"{c:g}" for c in CRITERIA])
        axes.tick_params(length=0)
        axes.set_xlabel("ω₀Φ/Ω (1)\namplitude Φ (rad)")
        axes.set_ylabel("swing criterion C (1)")
        axes.set_title("Thrust of swing, in % of the best square wave")
        figure.colorbar(image, extend="min", label="%  (bold: over 95 %)")


def verdicts(median: Array) -> tuple[str, str]:
    """Return the results of a map for each of the claims."""
    best, floor = median[CRITERIA.index(RECOMMENDED)], median[: CRITERIA.index(ANY_UPTO) + 1]
    missed = [f"{RATIOS[i]:g}" for i in np.flatnonzero(best <= NEARLY_BEST)]
    low = [f"C = {CRITERIA[i]:g} at {RATIOS[j]:g}" for i, j in np.argwhere(floor <= GOOD)]
    return (
        f"from {percent(np.nanmin(best))} % up; "
        + (f"less at ω₀Φ/Ω = {', '.join(missed)}" if missed else "holds"),
        f"from {percent(np.nanmin(floor))} % up; "
        + (f"less for {', '.join(low)}" if low else "holds"),
    )


def percent(value: float) -> str:
    """Format a fraction in %."""
    return f"{100 * value:.1f}"


def sections() -> list[tuple[str, str, str]]:
    """Return document, name of the markers, and the text between them."""
    maps = map(_map, ("median", "perfect_sensor", "continuous_time"))
    claims = table(
        "the paper | imperfect sensor | perfect sensor | continuous time",
        zip(CLAIMS, *map(verdicts, maps), strict=True),
    )
    return [(DOCUMENT, "swing claims", claims)]
