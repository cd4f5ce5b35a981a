"""Tests of the fish: its momentum, its speed with smaller cells and steps, and its cost."""

import math
import multiprocessing
import re
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.swimmer_elements import ElementStep, element_step
from common.report import progress, table
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import Numerics, SwimmerSettings

BEAT = 3.0
"""Frequency of the square wave [Hz]."""
SETTLE, BEATS = 18, 15
"""Number of beats until the swim is steady, and number of beats over which speed is averaged."""
START = 4
"""Number of first beats from rest, before the water becomes turbulent."""


def fish(cell: float, step: float) -> Fish:
    """Return the default fish; cell in mm, step in ms."""
    return Fish(SwimmerSettings(numerics=Numerics(cell=1e-3 * cell, step=1e-3 * step)))


def square(t: float) -> float:
    """Return the activation."""
    return 1.0 if (t * BEAT) % 1.0 < 0.5 else -1.0


class Swum(NamedTuple):
    """Result of a swim."""

    speed: float
    """Mean speed over the last beats [m/s]."""
    uncertainty: float
    """Standard error of `speed`, from the scatter of beats [m/s]."""
    started: float
    """Distance of the first beats [m]."""
    courant: float


def swum(cell: float, step: float) -> Swum:
    """Swim until the motion is steady, and measure further beats."""
    one = fish(cell, step)
    times, places, courant = [0.0], [one.motion().x], 0.0
    while one.time < (SETTLE + BEATS) / BEAT:
        one.step(square(one.time + 0.5 * one.dt))
        times.append(one.time)
        places.append(one.motion().x)
        if len(times) % 20 == 0:
            courant = max(courant, one.flow.courant_number(one.dt))
    passed = np.interp(np.arange(SETTLE + BEATS + 1) / BEAT, times, places)
    speeds = -np.diff(passed[SETTLE:]) * BEAT
    result = Swum(
        float(speeds.mean()),
        float(speeds.std(ddof=1)) / math.sqrt(BEATS),
        float(passed[1] - passed[START]),
        courant,
    )
    progress(f"{cell:g} mm", f"{step:g} ms", f"{result.speed:.4f} m/s", f"{result.started:.5f} m")
    return result


def order(values: Sequence[float]) -> tuple[float, float]:
    """Return the observed order and Richardson's limit of three values at halved sizes.

    NaN where the differences do not decrease.
    """
    first, second = values[1] - values[0], values[2] - values[1]
    if first * second <= 0.0 or abs(second) > 0.9 * abs(first):
        return math.nan, math.nan
    observed_order = math.log2(first / second)
    return observed_order, values[2] + second / (2.0**observed_order - 1.0)


def convergence(finest: float) -> str:
    """Return the table of speeds with finer cells and shorter steps."""
    space = [
        (2.0 * finest, 2.0 * finest),
        (1.0 * finest, 1.0 * finest),
        (0.5 * finest, 0.5 * finest),
    ]
    in_time = [(1.0 * finest, share * finest) for share in (1.0, 0.5, 0.25)]
    results = {pair: swum(*pair) for pair in dict.fromkeys([*space, *in_time])}
    rows = []
    for title, pairs in (("cells and steps", space), ("steps alone", in_time)):
        for cell, step in pairs:
            one = results[cell, step]
            rows.append(
                [
                    title,
                    f"{cell:g} mm, {step:g} ms",
                    f"{100 * one.speed:.2f} ± {100 * one.uncertainty:.2f}",
                    f"{1e3 * one.started:.2f}",
                    f"{one.courant:.2f}",
                ]
            )
        speeds = [results[pair].speed for pair in pairs]
        starts = [results[pair].started for pair in pairs]
        (p, limit), (q, far) = order(speeds), order(starts)
        rows.append(
            [
                title,
                "**observed order; limit**",
                f"**{p:.1f}; {100 * limit:.2f}**" if p == p else "**none: no steady trend**",
                f"**{q:.1f}; {1e3 * far:.2f}**" if q == q else "**none: no steady trend**",
                "",
            ]
        )
    heads = (
        f"what gets smaller | cell, step | speed (cm/s, mean of {BEATS} beats) | "
        f"way in beats 2 to {START} (mm) | Courant number"
    )
    return table(heads, rows)


def momentum(finest: float) -> str:
    """Return the change of momentum against the flux through the boundaries, step by step."""
    one = fish(2.0 * finest, 2.0 * finest)
    rho = one.settings.water.density
    gaps, terms, nets, forces = [], [], [], []
    for _ in range(500):
        before = rho * one.flow.momentum()
        one.step(square(one.time))
        gained, crossed = rho * one.flow.momentum() - before, rho * one.flow.boundary_impulse
        gaps.append(abs(gained - crossed))
        terms.append(max(abs(gained), abs(crossed)))
        nets.append(abs(float(one.body.force[:, 0].sum())))
        forces.append(float(np.abs(one.body.force[:, 0]).sum()))
    rows = [
        _closed("water and body: gained − crossed the boundaries", gaps, terms),
        _closed("body: net force of slices on the water in them", nets, forces),
    ]
    return table(
        "balance along x, 1 s of square wave | asked | worst gap over largest term | met", rows
    )


def _closed(name: str, gaps: list[float], terms: list[float]) -> list[str]:
    worst = max(gaps) / max(terms)
    return [name, "≤ 1e-6", f"{worst:.0e}", "yes" if worst <= 1e-6 else "**no**"]


class Cost(NamedTuple):
    """Cost of swimming on one core."""

    best: float
    """Shortest time per simulated second [s]."""
    median: float
    processor: float
    """Shortest processor time per simulated second [s]."""
    memory: float
    """Peak memory [MB]."""
    unknowns: int
    """Number of unknowns: two velocities and a pressure for each cell."""


def cost(cell: float, step: float) -> Cost:
    """Measure pieces of 100 steps, after 0.2 s."""
    one = fish(cell, step)
    while one.time < 0.2:
        one.step(square(one.time))
    pieces, busy = [], []
    for _ in range(12):
        begun, before = time.perf_counter(), time.process_time()
        for _ in range(100):
            one.step(square(one.time))
        pieces.append((time.perf_counter() - begun) / (100 * one.dt))
        busy.append((time.process_time() - before) / (100 * one.dt))
    status = Path("/proc/self/status").read_text(encoding="ascii")
    memory = int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 1024.0
    cells = one.flow.grid.cells
    return Cost(min(pieces), statistics.median(pieces), min(busy), memory, 3 * cells)


def speed(finest: float) -> str:
    """Return the time per simulated second in a separate process, and of a finite-element step."""
    rows = []
    costs = []
    context = multiprocessing.get_context("spawn")
    for cell, step, asked in ((1.0, 1.0, 2.5), (0.5, 0.5, 15.0)):
        with ProcessPoolExecutor(1, context) as pool:
            one = pool.submit(cost, cell * finest, step * finest).result()
        costs.append(one)
        small = cell > 0.5
        met = one.best <= asked and (one.memory <= 300.0 or not small)
        rows.append(
            [
                f"fishd, {cell * finest:g} mm, {step * finest:g} ms",
                f"{one.unknowns}",
                f"≤ {asked:g} s" + (", ≤ 300 MB" if small else ""),
                f"{one.best:.2f} s (median {one.median:.2f}; processor {one.processor:.2f}), "
                f"{one.memory:.0f} MB",
                "yes" if met else "**no**",
            ]
        )
        progress(*rows[-1])
    with ProcessPoolExecutor(1, context) as pool:
        other: ElementStep = pool.submit(element_step, costs[0].unknowns).result()
    steps = 1000 / finest
    least = steps * other.solve_seconds
    rows += [
        [
            "scikit-fem, Taylor–Hood, a step of 1 ms",
            f"{other.unknowns}",
            "",
            f"{other.solve_seconds:.2f} s for an iteration ({other.assembly_seconds:.2f} s of it "
            f"to assemble), {other.iterations} iterations",
            "",
        ],
        [
            f"the same, {steps:.0f} steps",
            f"{other.unknowns}",
            "≥ 100 times fishd's",
            f"{least * other.iterations:.0f} s: {least * other.iterations / costs[0].best:.0f} "
            f"times; {least / costs[0].best:.0f} times with one iteration in each step",
            "yes" if least / costs[0].best >= 100.0 else "**no**",
        ],
    ]
    return table("a simulated second, on one core | unknowns | asked | measured | met", rows)
