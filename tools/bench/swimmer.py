"""Speed of the free swimmer against a second method, finite elements fitted to its body.

    ale    finite elements of `body_fitted` on three meshes; a quarter of an hour for a body, and
           as long for --size 0.75
    grid   `fishd.virtual.swimmer` on cells of 1, 0.5 and 0.25 mm; two minutes for a body

Both swim the same fish from rest for four beats of a square wave, without steering. With --write
each run is kept in docs/figures/swimmer-methods.csv as it ends, and the table and the figure are of
all runs there. Runs that it has are not computed again without --again; so an interrupted
measurement continues.
"""

import csv
import math
import time
from argparse import Namespace
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec.structs import replace
from threadpoolctl import threadpool_limits

from common.report import DOCS, JOBS, Options, Report, progress, run_cases, table
from fishd.config import load
from fishd.lab.drawing import BLUE, ORANGE, open_figure
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.grid import Array

RUNS = DOCS / "figures" / "swimmer-methods.csv"
BEATS = 4
BODIES = {"damped": ("swimmer.yaml", 2.0), "undamped": ("swimmer-undamped.yaml", 3.0)}
"""Configuration of each body, and frequency of its square wave [Hz]."""
METHODS = {"ale": "finite elements", "grid": "fishd"}
SIZES = {"ale": (2.1, 1.5, 1.05), "grid": (1.0, 0.5, 0.25)}
"""Edges of the triangles in the middle of the body, and cells, coarsest first [mm]."""
GRID_STEPS_MS = {1.0: 0.5, 0.5: 0.4, 0.25: 0.2}
"""Largest time step with these cells [ms]."""
ALE_STEPS = 125
"""Number of time steps of the finite elements in half a beat."""


class Swimmer(Protocol):
    """Fish of either method."""

    def step(self, activation: float) -> None:
        """Advance by one step."""

    def reading(self) -> tuple[float, float, float]:
        """Return x [m], angle of the tail [rad] and work of the muscles [J/m]."""


class GridFish(Fish):
    """Fish of fishd, as a `Swimmer`."""

    def reading(self) -> tuple[float, float, float]:
        """Return x [m], angle of the tail [rad] and work of the muscles [J/m]."""
        motion = self.motion()
        return motion.x, motion.tail_angle, self.work.muscles


class Run(NamedTuple):
    """Mesh of a swim, its computing time, and results of its beats."""

    body: str
    method: str
    size: float
    """[mm]"""
    steps: int
    """Number of time steps in half a beat."""
    unknowns: int
    cpu: float
    """[s]"""
    speeds: tuple[float, ...]
    """Mean of each beat [mm/s]."""
    powers: tuple[float, ...]
    """Power of the muscles [mW/m]."""
    tail_angles: tuple[float, ...]
    """Range of the angle of the tail [rad]."""


def build(body: str, method: str, size: float, steps: int | None) -> tuple[Swimmer, int, int]:
    """Return a fish, its number of steps in half a beat, and its number of unknowns."""
    name, frequency = BODIES[body]
    settings = replace(load(DOCS.parent / "config" / name).swimmer, steering=0.0)
    cell = size if method == "grid" else min(GRID_STEPS_MS)  # the beam has a slice for each cell
    longest = GRID_STEPS_MS.get(size, 0.5 * size)
    usual = ALE_STEPS if method == "ale" else math.ceil(500.0 / frequency / longest - 1e-9)
    steps = steps or usual
    dt = 0.5 / frequency / steps
    settings = replace(settings, numerics=replace(settings.numerics, cell=1e-3 * cell, step=dt))
    if method == "grid":
        fish = GridFish(settings)
        return fish, steps, 3 * fish.flow.grid.cells
    from bench.body_fitted import BodyFitted

    elements = BodyFitted(settings, 1e-3 * size, dt)
    return elements, steps, elements.space.ndof


def swim(case: tuple[str, str, float], steps: int | None, *, keep: bool) -> Run:
    """Swim from rest; case: body, method, size; keep: whether the run is added to `RUNS`."""
    body, method, size = case
    with threadpool_limits(1):
        began = time.process_time()
        fish, half_beat, unknowns = build(body, method, size, steps)
        frequency, rows = BODIES[body][1], [fish.reading()]
        for k in range(2 * BEATS * half_beat):
            fish.step(1.0 if k // half_beat % 2 == 0 else -1.0)
            rows.append(fish.reading())
            if (k + 1) % (2 * half_beat) == 0:
                speed = 1e3 * frequency * (rows[-1 - 2 * half_beat][0] - rows[-1][0])
                progress(
                    body,
                    method,
                    f"{size} mm",
                    f"beat {(k + 1) // 2 // half_beat}",
                    f"{speed:.2f} mm/s",
                )
        cpu = time.process_time() - began
    run = Run(body, method, size, half_beat, unknowns, cpu, *results(np.array(rows), frequency))
    if keep:
        with RUNS.open("a", encoding="utf-8", newline="") as file:
            write_rows(file, [run])
    return run


def results(rows: Array, frequency: float) -> list[tuple[float, ...]]:
    """Return speeds, powers and ranges of the tail's angle of the beats; a row is a step."""
    x, angle, work = rows.T
    beat = (len(rows) - 1) // BEATS
    speeds, powers = (np.diff(values[::beat]) * 1e3 * frequency for values in (-x, work))
    ranges = [np.ptp(angle[k * beat : (k + 1) * beat + 1]) for k in range(BEATS)]
    return [tuple(map(float, values)) for values in (speeds, powers, ranges)]


def write_rows(file: Any, runs: Iterable[Run]) -> None:
    """Write runs into an open CSV file."""
    writer = csv.writer(file, lineterminator="\n")
    for run in runs:
        beats = [f"{value:.4f}" for values in run[6:] for value in values]
        writer.writerow([*run[:5], f"{run.cpu:.0f}", *beats])


def read_runs() -> dict[tuple[str, str, float], Run]:
    """Return the kept runs; the last of several of a case."""
    lines = RUNS.read_text(encoding="utf-8").splitlines() if RUNS.exists() else []
    runs = {}
    for body, method, size, steps, unknowns, cpu, *values in csv.reader(lines):
        beats = map(tuple, np.array(values, float).reshape(3, BEATS).tolist())
        run = Run(body, method, float(size), int(steps), int(unknowns), float(cpu), *beats)
        runs[run[:3]] = run
    return runs


OPTIONS: Options = {
    "method": {"nargs": "*", "help": "ale, grid (default: both)"},
    "--body": {"nargs": "+", "choices": [*BODIES], "default": [*BODIES], "help": "bodies"},
    "--size": {"nargs": "+", "type": float, "help": "edges or cells [mm] (default: three)"},
    "--steps": {"type": int, "help": "time steps in half a beat"},
    "--again": {"action": "store_true", "help": "compute runs that are kept"},
    **JOBS,
}


def measure(options: Namespace) -> Report:
    """Swim all cases that are not kept, and return the table of these and of the kept ones."""
    if unknown := {*options.method} - {*METHODS}:
        raise SystemExit(f"{', '.join(sorted(unknown))}: a method is one of {', '.join(METHODS)}")
    kept = read_runs()
    cases = [
        (body, method, size)
        for body in options.body
        for method in options.method or METHODS
        for size in options.size or SIZES[method]
    ]
    fresh = [case for case in cases if options.again or case not in kept]
    swims = partial(swim, steps=options.steps, keep=options.write)
    order = [*METHODS]
    done = run_cases(swims, fresh, options.jobs)
    runs = read_runs() | {run[:3]: run for run in done}  # others may have been kept meanwhile
    ordered = sorted(runs.values(), key=lambda run: (run.body, order.index(run.method), -run.size))
    if options.write:
        with RUNS.open("w", encoding="utf-8", newline="") as file:
            write_rows(file, ordered)
        draw(ordered)
    head = (
        "body | method | mm | CPU s | beat 1 | 2 | 3 | 4 (mm/s) | power (mW/m) | tail angle (rad)"
    )
    rows = [row for body in BODIES for row in table_rows([r for r in ordered if r.body == body])]
    return Report({"bench swimmer": table(head, rows)}, ordered)


def table_rows(runs: Sequence[Run]) -> list[list[str]]:
    """Return the finest run of a body by each method, the last change, and the deviations."""
    rows: list[list[str]] = []

    def add(what: str, ratios: Array) -> None:
        rows.append([runs[0].body, what, "", "", *(f"{ratio - 1.0:+.1%}" for ratio in ratios)])

    values: dict[str, list[Array]] = {}
    for method, name in METHODS.items():
        same = [run for run in runs if run.method == method]
        values[method] = [values_of(run) for run in same]
        for run in same[-1:]:
            *speeds_and_power, angle = values[method][-1]
            cells = [*(f"{value:.2f}" for value in speeds_and_power), f"{angle:.4f}"]
            rows.append([run.body, name, f"{run.size:g}", f"{run.cpu:.0f}", *cells])
        if len(same) > 1:
            add(f"{name}, last change", values[method][-1] / values[method][-2])
    elements, grid = values["ale"], values["grid"]
    if elements and grid:
        add(f"fishd, {runs[-1].size:g} mm, to finest elements", grid[-1] / elements[-1])
    if elements and len(grid) > 1:
        limit = grid[-1].copy()  # power and angle have converged
        change = (grid[-1] - grid[-2]) / (runs[-2].size / runs[-1].size - 1.0)
        limit[:BEATS] += change[:BEATS]
        add("fishd, first-order limit of speed, to finest elements", limit / elements[-1])
    return rows


def values_of(run: Run) -> Array:
    """Return the speeds of the beats, and power and angle of the tail in the last."""
    return np.array([*run.speeds, run.powers[-1], run.tail_angles[-1]])


def draw(runs: Sequence[Run]) -> None:
    """Draw the speed of each beat by both methods, a panel for each body."""
    with open_figure(RUNS.with_suffix(".svg"), (7.2, 3.4)) as figure:
        for axis, (body, (_, frequency)) in zip(figure.subplots(1, 2), BODIES.items(), strict=True):
            for method, colour in zip(METHODS, (BLUE, ORANGE), strict=True):
                same = [run for run in runs if (run.body, run.method) == (body, method)]
                for run, style in zip(reversed(same), ("-", "--", ":", "-."), strict=False):
                    label = f"{METHODS[method]}, {run.size:g} mm"
                    beats = range(1, BEATS + 1)
                    axis.plot(beats, run.speeds, style, marker=".", color=colour, label=label)
            axis.set_title(f"{body} body, {frequency:g} Hz")
            axis.set_xticks(range(1, BEATS + 1))
            axis.set_ylim(0.0)
            axis.set_xlabel("beat from rest")
            axis.set_ylabel("mean speed (mm/s)")
            axis.legend()
