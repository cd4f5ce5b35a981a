"""How near `swing` comes to the best square wave; draws docs/swing-efficiency.png with --write.

Each number is the median of several runs of the robot's own loop on a simulated fish with an
imperfect force sensor; the runs differ in the seed of noise and drift.
"""

import csv
import itertools
import math
import os
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from common.report import DOCS, Options, Report, table
from fishd.config import Config
from fishd.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

DOCUMENT = "swing-efficiency.md"
FIGURE = DOCS / "swing-efficiency.png"
REFERENCE = DOCS.parent / "tests" / "reference" / "swing_efficiency.csv"

CRITERIA = tuple(tenths / 10 for tenths in range(11))
"""C."""
RATIOS = (0.1, 0.25, 0.5, 0.9, 1.5, 2.0, 3.0)
"""ω₀Φ/Ω."""
REAL = SimulationSettings(noise=0.001, offset_y=0.02, drift=0.02)
PERFECT = SimulationSettings(noise=0.0)
SECONDS, SETTLE = 200.0, 20.0
"""What is judged is three periods of the drift long."""

RECOMMENDED, NEARLY_BEST = 0.6, 0.95
"""The paper: C = 0.6 gives over 95 % of the optimum for every ω₀Φ/Ω."""
ANY_UPTO, GOOD = 0.8, 0.7
"""The paper: any C in 0 … 0.8 gives over 70 %."""
CLAIMS = (
    f"C = {RECOMMENDED:g}: over {100 * NEARLY_BEST:g} % for every ω₀Φ/Ω",
    f"any C in 0 … {ANY_UPTO:g}: over {100 * GOOD:g} %",
)

Array = NDArray[np.float64]


def amplitude(ratio: float) -> float:
    """Φ at a given ω₀Φ/Ω of the default fish [rad]."""
    plant = PlantParameters()
    return ratio * plant.servo_speed / plant.omega0


def efficiency(run: tuple[float, float, SimulationSettings]) -> float:
    """Thrust over that of the best square wave, for C, ω₀Φ/Ω and a rig; zero after a fault."""
    criterion, ratio, rig = run
    config = Config(amplitude_limit=amplitude(ratio), simulation=rig)
    report = simulate(config, "swing", {"C": criterion}, SECONDS, SETTLE)
    return 0.0 if report.reason else report.efficiency


def efficiencies(rig: SimulationSettings, seeds: int, jobs: int) -> Array:
    """Every efficiency, of shape (criteria, ratios, seeds)."""
    rigs = [msgspec.structs.replace(rig, seed=seed) for seed in range(seeds)]
    runs = list(itertools.product(CRITERIA, RATIOS, rigs))
    with ProcessPoolExecutor(jobs) as pool:
        done = list(pool.map(efficiency, runs, chunksize=seeds))
    return np.array(done).reshape(len(CRITERIA), len(RATIOS), seeds)


def continuous_time() -> Array:
    """The same with the true fin velocity and no tick; NaN where it was not computed."""
    known = np.full((len(CRITERIA), len(RATIOS)), np.nan)
    with REFERENCE.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            criterion, ratio = float(row["C"]), float(row["w0Phi_over_Omega"])
            if criterion in CRITERIA and ratio in RATIOS:
                known[CRITERIA.index(criterion), RATIOS.index(ratio)] = float(row["efficiency"])
    return known


def draw(median: Array, path: Path) -> None:
    """The map of medians."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    figure = Figure(figsize=(8, 6), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(
        100 * median, cmap="cividis", vmin=50, vmax=100, origin="lower", aspect="auto"
    )
    for (row, column), value in np.ndenumerate(median):
        colour = "black" if value > 0.75 else "white"
        weight = "bold" if value > NEARLY_BEST else "normal"
        text = axes.text(column, row, percent(value), color=colour, weight=weight)
        text.set(ha="center", va="center")
    row = CRITERIA.index(RECOMMENDED)
    axes.add_patch(Rectangle((-0.48, row - 0.48), len(RATIOS) - 0.04, 0.96, fill=False, lw=2))
    axes.set_xticks(range(len(RATIOS)), [f"{r:g}\n{amplitude(r):.3f}" for r in RATIOS])
    axes.set_yticks(range(len(CRITERIA)), [f"{c:g}" for c in CRITERIA])
    axes.set_xlabel("ω₀Φ/Ω  [1]\namplitude Φ  [rad]")
    axes.set_ylabel("swing criterion C  [1]")
    axes.set_title("Thrust of swing, in % of the best square wave")
    figure.colorbar(image, extend="min", label="%  (bold: over 95 %)")
    figure.savefig(path, dpi=150)


def verdicts(median: Array) -> tuple[str, str]:
    """What a map says to each of the claims."""
    best, floor = median[CRITERIA.index(RECOMMENDED)], median[: CRITERIA.index(ANY_UPTO) + 1]
    missed = [f"{RATIOS[i]:g}" for i in np.flatnonzero(best <= NEARLY_BEST)]
    low = [f"C = {CRITERIA[i]:g} at {RATIOS[j]:g}" for i, j in np.argwhere(floor <= GOOD)]
    return (
        f"from {percent(np.nanmin(best))} % up; "
        + (f"less at ω₀Φ/Ω = {', '.join(missed)}" if missed else "holds"),
        f"from {percent(np.nanmin(floor))} % up; "
        + (f"less for {', '.join(low)}" if low else "holds"),
    )


def percent(value: float, exact: float = math.nan) -> str:
    """A share in percent, and in brackets what it should be; a dash where there is none."""
    known = "" if math.isnan(exact) else f" ({percent(exact)})"
    return "–" if math.isnan(value) else f"{100 * value:.1f}{known}"


def sections(real: Array, perfect: Array) -> dict[str, str]:
    """What belongs into docs/swing-efficiency.md."""
    median, exact = np.median(real, axis=2), continuous_time()
    spread = np.ptp(real, axis=2)
    widest = np.unravel_index(np.argmax(spread), spread.shape)
    row = CRITERIA.index(RECOMMENDED)
    ratios = [f"{ratio:g}" for ratio in RATIOS]
    everything = table(
        " | ".join(["C \\ ω₀Φ/Ω", *ratios]),
        (
            [f"{c:g}", *map(percent, *both)]
            for c, *both in zip(CRITERIA, median, exact, strict=True)
        ),
    )
    claims = table(
        "the paper | imperfect sensor | perfect sensor | continuous time",
        zip(CLAIMS, *map(verdicts, (median, perfect, exact)), strict=True),
    )
    details = table(
        " | ".join(["ω₀Φ/Ω", *ratios]),
        [
            ["amplitude Φ, rad", *(f"{amplitude(ratio):.3f}" for ratio in RATIOS)],
            ["imperfect sensor, median", *map(percent, median[row])],
            ["imperfect sensor, worst seed", *map(percent, real[row].min(axis=1))],
            ["perfect sensor", *map(percent, perfect[row])],
            ["continuous time", *map(percent, exact[row])],
        ],
    )
    return {
        "bench swing": f"{everything}\n\nEach cell is the median of {real.shape[2]} runs; two of "
        f"one cell differ by no more than {percent(spread[widest])} points "
        f"(C = {CRITERIA[widest[0]]:g} and ω₀Φ/Ω = {RATIOS[widest[1]]:g}).",
        "bench swing claims": f"{claims}\n\nC = {RECOMMENDED:g} in detail, in %:\n\n{details}",
    }


OPTIONS: Options = {
    "--seeds": {"type": int, "default": 10, "help": "runs of each cell; default 10"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """The map of the imperfect rig, and of a perfect one; some minutes."""
    real = efficiencies(REAL, options.seeds, options.jobs)
    perfect = efficiencies(PERFECT, 1, options.jobs)[:, :, 0]
    if options.write:
        draw(np.median(real, axis=2), FIGURE)
    return Report(sections(real, perfect), {"real": real.tolist(), "perfect": perfect.tolist()})
