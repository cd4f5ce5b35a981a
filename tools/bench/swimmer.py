"""Accuracy of the free swimmer, compared with published values.

    turek-hron    elastic flag behind a cylinder, cases FSI3 and FSI2; eight minutes
    cylinder      fixed cylinder at a Reynolds number of 100, far from any wall; one minute
    impulsive, anguilliform, rigid: see `swimmer_flows`; one minute, three, and three

Turek and Hron, Proposal for numerical benchmarking of fluid–structure interaction between an
elastic object and laminar incompressible flow, Springer 2006, doi:10.1007/3-540-34596-5_15. The
authors' site, Featflow, has newer tables with finer steps, quoted here as solids4foam has them
(tutorials/fluidSolidInteraction/HronTurekFsi3/verification/README.md, in its repository): FSI3
swings at 5.46 Hz in them, not at 5.3.

The values of the cylinder are those collected by Qu, Norberg, Davidson, Peng and Wang, J. Fluids
Struct. 39, 2013, pp. 347–370, doi:10.1016/j.jfluidstructs.2013.02.007, table 1.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # before numpy is loaded

import math  # noqa: E402
import time  # noqa: E402
from argparse import Namespace  # noqa: E402
from functools import partial  # noqa: E402
from typing import NamedTuple  # noqa: E402

import numpy as np  # noqa: E402

from bench import swimmer_flows  # noqa: E402
from common.machine import machine_in_short  # noqa: E402
from common.report import Options, Report, progress, table  # noqa: E402
from fishd.virtual.swimmer.beam import Beam, Profile  # noqa: E402
from fishd.virtual.swimmer.flow import Flow  # noqa: E402
from fishd.virtual.swimmer.grid import Array, Grid, edges  # noqa: E402
from fishd.virtual.swimmer.immersed import Immersed  # noqa: E402

RHO = 1000.0
RADIUS, CENTRE, HEIGHT, LENGTH, TIP, THICKNESS = 0.05, 0.2, 0.41, 2.5, 0.6, 0.02
"""Sizes of the benchmark's cylinder, channel and flag [m]."""
POISSON = 0.4
RAMP = 1.0
"""Duration of the increase of the inflow [s]."""


class Wave(NamedTuple):
    """Mean and amplitude of an oscillating quantity, as in the benchmark."""

    mean: float
    """Mean of the highest and the lowest value."""
    amplitude: float

    def text(self, factor: float = 1.0, digits: int = 2) -> str:
        """Format mean and amplitude."""
        mean, amplitude = factor * self.mean, factor * self.amplitude
        return f"{mean:.{digits}f} ± {amplitude:.{digits}f}"


class Case(NamedTuple):
    """Flow of the benchmark."""

    inflow: float
    """Mean velocity of the inflow [m/s]."""
    density: float
    """Density of the flag [kg/m³]."""
    shear_modulus: float
    """[Pa]"""
    runs: tuple[tuple[float, float], ...]
    """Sizes of the cells [m], and durations of the runs [s]."""
    step: float
    """Time step with cells of 5 mm [s]."""
    allowed: float
    """Allowed relative deviation of amplitude and frequency."""
    published: dict[str, tuple[Wave, float, str, str]]
    """Published u_y [m], frequency [Hz], drag and lift, by source."""


PROPOSAL = "Turek and Hron 2006"
FEATFLOW = "Featflow, newer, level 4"
CASES = {
    "FSI3": Case(
        2.0, 1000.0, 2e6, ((5e-3, 6.0), (2.5e-3, 6.0), (5e-3 / 3.0, 4.2)), 4e-4, 0.03,
        {
            PROPOSAL: (Wave(1.48e-3, 34.38e-3), 5.3, "457.3 ± 22.7", "2.2 ± 149.8"),
            FEATFLOW: (Wave(1.47e-3, 34.99e-3), 5.46, "460.5 ± 27.7", "2.5 ± 153.9"),
        },
    ),
    "FSI2": Case(
        1.0, 10000.0, 0.5e6, ((5e-3, 16.0), (2.5e-3, 16.0)), 5e-4, 0.05,
        {
            PROPOSAL: (Wave(1.23e-3, 80.6e-3), 2.0, "208.8 ± 73.8", "0.9 ± 234.2"),
            FEATFLOW: (Wave(1.30e-3, 81.6e-3), 1.93, "215.1 ± 77.7", "0.6 ± 237.8"),
        },
    ),
}  # fmt: skip


class Swing(NamedTuple):
    """Motion of a flag."""

    across: Wave
    """u_y of its tip [m]."""
    frequency: float
    """[Hz]"""
    drag: Wave
    """[N/m]"""
    lift: Wave


def flag(case: Case, cell: float) -> Immersed:
    """Return the channel with cylinder and flag, at rest."""
    rows = round(HEIGHT / cell)
    h = HEIGHT / rows
    root = CENTRE + math.sqrt(RADIUS**2 - 0.25 * THICKNESS**2)
    grid = Grid(edges(0.0, LENGTH, (0.13, 0.62), h, 1.05), np.linspace(0.0, HEIGHT, rows + 1))
    young = 2.0 * case.shear_modulus * (1.0 + POISSON)
    stiffness = young / (1.0 - POISSON**2) * THICKNESS**3 / 12.0
    beam = Beam(
        TIP - root,
        even(0.5 * THICKNESS),
        even(stiffness),
        20,
        0.5 * h,
        density=case.density - RHO,
        clamped=True,
    )
    beam.q[:2] = root, CENTRE
    body = Immersed(Flow(grid, 1e-3, "no-slip"), RHO, beam)
    body.add_circle(CENTRE, CENTRE, RADIUS)
    return body


def even(value: float) -> Profile:
    """Return a constant profile."""
    return lambda X: np.full_like(X, value)


def swing(case: Case, cell: float, end: float) -> Swing:
    """Simulate the flag, and measure its last five periods."""
    body, dt = flag(case, cell), case.step * cell / 5e-3
    beam, grid = body.beam, body.flow.grid
    assert beam
    profile = grid.yc * (HEIGHT - grid.yc)
    profile *= case.inflow / float(grid.dy @ profile / HEIGHT)
    steps = round(end / dt)
    history = np.empty((steps, 4))
    for k in range(steps):
        t = (k + 1) * dt
        body.flow.inlet = profile * 0.5 * (1.0 - math.cos(math.pi * min(1.0, t / RAMP)))
        before = body.velocity
        body.step(dt)
        places, angle = beam.shape(beam.q)
        gained = (body.mass @ (body.velocity - before)[:, :, None])[:, :2, 0] / dt
        force = (gained - body.force[:, :2]).sum(axis=0) + body.fixed_impulse / dt
        tip = places[-1, 1] + 0.5 * beam.spacing * math.sin(angle[-1])
        history[k] = t, tip - CENTRE, *force
    t, across = history[:, 0], history[:, 1]
    rising = crossings(t, across)[-6:]
    last = history[t >= rising[0]]
    return Swing(
        wave(last[:, 1]), 5.0 / (rising[-1] - rising[0]), wave(last[:, 2]), wave(last[:, 3])
    )


def crossings(t: Array, values: Array) -> Array:
    """Return the times at which values rise through their mean of the last third."""
    offset = values - values[2 * len(values) // 3 :].mean()
    k = np.flatnonzero((offset[:-1] < 0.0) & (offset[1:] >= 0.0))
    return np.asarray(t[k] - offset[k] / (offset[k + 1] - offset[k]) * (t[k + 1] - t[k]))


def wave(values: Array) -> Wave:
    """Return mean and amplitude of a history."""
    low, high = float(values.min()), float(values.max())
    return Wave(0.5 * (high + low), 0.5 * (high - low))


def turek_hron(finest: float) -> tuple[str, str]:
    """Return the table of FSI3 and FSI2, and the deviations on the finest cells from Featflow."""
    rows, numbers = [], []
    for name, case in CASES.items():
        for source, (across, frequency, drag, lift) in case.published.items():
            rows.append([name, source, across.text(1e3), f"{frequency:g}", drag, lift, "", ""])
        for coarse, end in case.runs:
            cell = coarse * finest
            result = swing(case, cell, end)
            rows.append(
                [
                    name,
                    f"here, cells of {cell * 1e3:.3g} mm",
                    result.across.text(1e3),
                    f"{result.frequency:.3f}",
                    result.drag.text(digits=1),
                    result.lift.text(digits=1),
                    *deviations(result, case),
                ]
            )
            progress(*rows[-1])
        numbers.append(f"{name}, {cell * 1e3:.3g} mm: {rows[-1][-1]}")
    heads = (
        "case | source | u_y (mm) | f (Hz) | drag (N/m) | lift (N/m) | "
        "u_y and f: deviation from 2006 | deviation from newer"
    )
    return table(heads, rows), "; ".join(numbers)


def deviations(result: Swing, case: Case) -> list[str]:
    """Return the deviations of amplitude and frequency from each publication; ✓ where allowed."""
    cells = []
    for across, frequency, _, _ in case.published.values():
        off = result.across.amplitude / across.amplitude - 1.0, result.frequency / frequency - 1.0
        met = max(map(abs, off)) <= case.allowed
        cells.append(f"{off[0]:+.1%}, {off[1]:+.1%}" + (" ✓" if met else ""))
    return cells


CYLINDER = {
    "Williamson 1989, experiment": ("0.164", ""),
    "Park, Kwon and Choi 1998": ("0.165", "1.33"),
    "Posdziech and Grundmann 2007": ("0.1644", "1.325"),
    "Qu, Norberg, Davidson, Peng and Wang 2013": ("0.1648", "1.319"),
}
STROUHAL, DRAG = (0.164, 0.165), (1.319, 1.33)
"""Lowest and highest published values."""


def past_cylinder(cells: int) -> tuple[float, float]:
    """Return Strouhal number and mean drag coefficient, for diameter 1, velocity 1 and Re = 100."""
    h = 1.0 / cells
    dt = min(0.2 * h, 4.8 * h * h)  # advection; diffusion
    x, y = edges(-40.0, 80.0, (-1.0, 3.0), h, 1.05), edges(-40.0, 40.0, (-1.0, 1.0), h, 1.05)
    grid = Grid(x, y)
    flow = Flow(grid, 0.01, "slip", inlet=np.ones(grid.ny))
    flow.u[:] = 1.0
    flow.v[:, 1:-1] = 0.3 * np.exp(-((grid.xc[:, None] - 1.5) ** 2 + grid.y[None, 1:-1] ** 2))
    body = Immersed(flow, 1.0)
    body.add_circle(0.0, 0.0, 0.5)
    steps = round(100.0 / dt)
    force = np.empty((steps, 2))
    for k in range(steps):
        body.step(dt)
        force[k] = 2.0 * body.fixed_impulse / dt
    t = dt * np.arange(1, steps + 1)
    rising = crossings(t, force[:, 1])[-6:]
    inside = (t >= rising[0]) & (t < rising[-1])
    return 5.0 / float(rising[-1] - rising[0]), float(force[inside, 0].mean())


def cylinder(finest: float) -> tuple[str, str]:
    """Return the table of Strouhal number and drag at Re = 100, and their deviations."""
    rows = [[source, *values, ""] for source, values in CYLINDER.items()]
    for cells in (20, 40):
        results = past_cylinder(round(cells / finest))
        off = [outside(value, band) for value, band in zip(results, (STROUHAL, DRAG), strict=True)]
        rows.append(
            [
                f"here, {round(cells / finest)} cells across",
                f"{results[0]:.4f}",
                f"{results[1]:.3f}",
                f"{off[0]:+.1%}, {off[1]:+.1%}" + (" ✓" if max(map(abs, off)) <= 0.02 else ""),
            ]
        )
        progress(*rows[-1])
    heads = "source | Strouhal number | mean drag | deviation from the published range"
    return table(heads, rows), f"{rows[-1][0].removeprefix('here, ')}: {rows[-1][-1]}"


def outside(value: float, band: tuple[float, float]) -> float:
    """Return the relative distance from the nearest published value; 0 between them."""
    nearest = min(max(value, band[0]), band[1])
    return value / nearest - 1.0


FLOWS = {"turek-hron": turek_hron, "cylinder": cylinder, **swimmer_flows.FLOWS}
OPTIONS: Options = {
    "--finest": {
        "type": float,
        "default": 1.0,
        "help": "size of the cells, relative to that of the tables (default: 1)",
    },
}


def _measure(part: str, options: Namespace) -> Report:
    """Return the table of one flow, with the time that it took."""
    start = time.perf_counter()
    text, number = FLOWS[part](options.finest)
    seconds = time.perf_counter() - start
    about = f"`tools/bench swimmer {part}`, {seconds:.0f} s; {machine_in_short()}"
    return Report({f"bench swimmer {part}": f"{text}\n\n{about}"}, text, number=number)


PARTS = {part: partial(_measure, part) for part in FLOWS}
