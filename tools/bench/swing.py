"""Writes docs/swing-efficiency.md and its figure: how near `swing` comes to the best square wave.

Each number is the median of several runs of the robot's own loop on a simulated fish with an
imperfect force sensor; the runs differ in the seed of noise and drift.
"""

import csv
import itertools
import math
import os
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from pathlib import Path

import click
import msgspec
import numpy as np
from numpy.typing import NDArray

from fishd.config import Config
from fishd.hardware.imperfections import SimulationSettings
from fishd.plant.parameters import PlantParameters
from fishd.simulation import simulate

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = ROOT / "docs" / "swing-efficiency.md"
FIGURE = DOCUMENT.with_suffix(".png")
REFERENCE = ROOT / "tests" / "reference" / "swing_efficiency.csv"

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

TEXT = """\
# How good is swinging control?

<!-- Written by tools/efficiency_map.py; change that program and run it again. -->

`swing` reverses the tail when the fin slows to C times its last top speed. It knows nothing of
the fish. This page compares its mean thrust with that of the best square wave of the same
amplitude, at the best of all frequencies, on the simulated fish with its default parameters.

Every number of the loop comes from one run of

```console
$ python tools/efficiency_map.py --seeds {seeds}
```

which swims the robot's own loop in virtual time: ticks of {tick:g} ms, and a force sensor with
{noise:g} mN of noise, an offset of {offset:g} mN on F_y and a slow drift of {drift:g} mN. Each
cell is the median of {seeds} runs that differ in noise and in the phase of the drift. A run
takes {seconds:g} s; its first {settle:g} s are not judged.

![Map of the efficiency over C and ω₀Φ/Ω](swing-efficiency.png)

Efficiency in %. In brackets, what the same equations give in continuous time, without ticks and
with the true fin velocity, where an independent integrator has computed it
([swing_efficiency.csv](../tests/reference/swing_efficiency.csv)):

{medians}
Two seeds of one cell differ by no more than {spread}.

## The paper's two claims

They are those of Fu et al., *Optimum control strategies for maximum thrust production in underwater
undulatory swimming*. The second column is the same loop without noise, offset and drift. The third
knows fewer cells.

{claims}
C = {standard:g} in detail, in %:

{details}
## How to read this

- C = {standard:g} is a good choice on the imperfect rig, as the paper says. At the largest
  amplitude it misses the claim, but there it does so in continuous time too. A larger C is better
  where the servo is slow.
- C near 0 is a poor choice at small amplitudes. The robot has no sensor of the fin velocity; it
  integrates F_y. Drift leaves an error in that integral which does not shrink with the amplitude,
  so a fin that hardly moves seems to slow down late.
- Some cells beat continuous time. A reversal waits for the next tick, as if C were smaller: good
  where C is too large. Taking the offset off F_y makes the estimate lead the fin a little, as if C
  were larger: good where C is too small.
- Neighbouring cells that are equal reverse at the same ticks. Noise can help: it spreads reversals
  over neighbouring ticks, so the frequency is no longer bound to whole ticks.
"""


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


def measure(rig: SimulationSettings, seeds: int, jobs: int) -> Array:
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


def draw(median: Array) -> None:
    """The map of medians as docs/swing-efficiency.png."""
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
    figure.savefig(FIGURE, dpi=150)


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


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown, headed by names."""
    names = list(head)
    lines = [names, ["---"] * len(names), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def document(real: Array, perfect: Array) -> str:
    """The text of docs/swing-efficiency.md."""
    median, exact = np.median(real, axis=2), continuous_time()
    spread = np.ptp(real, axis=2)
    widest = np.unravel_index(np.argmax(spread), spread.shape)
    row = CRITERIA.index(RECOMMENDED)
    ratios = [f"{ratio:g}" for ratio in RATIOS]
    return TEXT.format(
        noise=REAL.noise * 1e3,
        offset=REAL.offset_y * 1e3,
        drift=REAL.drift * 1e3,
        tick=Config().tick * 1e3,
        seconds=SECONDS,
        settle=SETTLE,
        seeds=real.shape[2],
        medians=table(
            ["C \\ ω₀Φ/Ω", *ratios],
            (
                [f"{c:g}", *map(percent, *both)]
                for c, *both in zip(CRITERIA, median, exact, strict=True)
            ),
        ),
        claims=table(
            ["the paper", "imperfect sensor", "perfect sensor", "continuous time"],
            zip(CLAIMS, *map(verdicts, (median, perfect, exact)), strict=True),
        ),
        standard=RECOMMENDED,
        details=table(
            ["ω₀Φ/Ω", *ratios],
            [
                ["amplitude Φ, rad", *(f"{amplitude(ratio):.3f}" for ratio in RATIOS)],
                ["imperfect sensor, median", *map(percent, median[row])],
                ["imperfect sensor, worst seed", *map(percent, real[row].min(axis=1))],
                ["perfect sensor", *map(percent, perfect[row])],
                ["continuous time", *map(percent, exact[row])],
            ],
        ),
        spread=f"{percent(spread[widest])} points (C = {CRITERIA[widest[0]]:g} and "
        f"ω₀Φ/Ω = {RATIOS[widest[1]]:g})",
    )


@click.command()
@click.option("--seeds", type=click.IntRange(min=1), default=10, show_default=True)
@click.option("--jobs", type=click.IntRange(min=1), default=os.cpu_count(), help="Processes.")
def main(seeds: int, jobs: int) -> None:
    """Measure how near swing comes to the best square wave; write docs/swing-efficiency.*."""
    if find_spec("matplotlib") is None:
        click.echo("efficiency_map: matplotlib is missing: pip install 'fishd[lab]'", err=True)
        sys.exit(1)
    real, perfect = measure(REAL, seeds, jobs), measure(PERFECT, 1, jobs)[:, :, 0]
    draw(np.median(real, axis=2))
    DOCUMENT.write_text(document(real, perfect), encoding="utf-8")


if __name__ == "__main__":
    main()
