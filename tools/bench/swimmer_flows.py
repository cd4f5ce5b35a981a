"""Flows around bodies whose motion is given, for `tools/bench swimmer`.

    impulsive     cylinder that starts at once, Re 550 and 3000
    anguilliform  swimmer that undulates like an eel, and swims freely
    rigid         fish at rest in a stream, Re 10 000

Impulsive start: Koumoutsakos and Leonard, J. Fluid Mech. 296, 1995, pp. 1–38,
doi:10.1017/S0022112095002059, digitised in PetIBM (examples/data, in its repository). Undulation:
Gazzola, Chatelain, van Rees and Koumoutsakos, J. Comput. Phys. 230, 2011, pp. 7093–7114,
doi:10.1016/j.jcp.2011.04.025, equation 45, as set up in SophT (examples/2d_examples/
FishSwimmingCase, in its repository).
"""

import math
from collections.abc import Callable

import numpy as np

from common.report import progress, table
from fishd.config import load
from fishd.core import files
from fishd.virtual.swimmer.beam import Beam
from fishd.virtual.swimmer.body import build_beam
from fishd.virtual.swimmer.fish import FOLLOW_TIME, RECENTRE_RATE, Fish
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.immersed import Immersed

IMPULSIVE = {
    550: (80, ((0.449, 0.754), (0.794, 0.703), (2.893, 1.287), (4.807, 1.137), (6.983, 1.021))),
    3000: (160, ((0.608, 0.307), (2.854, 1.160), (3.679, 1.423), (5.994, 1.036))),
}
"""Cells across and published drag coefficients at times Ut/R, by Reynolds number."""
PERIODS = 8
UNDULATION_VISCOSITY = 1.4e-4
"""Kinematic viscosity in lengths² per period."""
SWIMMER = files.shipped_folder("config") / "swimmer.yaml"
STREAM = 0.1
"""Speed of the stream past the rigid fish [m/s]."""


class GivenBody(Immersed):
    """Body whose shape is given at all times; its position and direction are free, or held."""

    def __init__(
        self, flow: Flow, density: float, beam: Beam, rates: Callable[[float], Array] | None = None
    ) -> None:
        """rates: θ̇ of the beam's points at a time, without a turn of the whole; None to hold it"""
        super().__init__(flow, density, beam)
        self.time = 0.0
        self._rates = rates

    def _solve(
        self, beam: Beam, dt: float, jacobian: Array, momentum: Array, forces: Array | None
    ) -> Array:
        """Return the rates that keep the total momentum of the body in all rigid motions."""
        self.time += dt
        shape = np.zeros(beam.size)
        if self._rates is None:
            return shape
        shape[2:] = self._rates(self.time)
        rigid = np.zeros((beam.size, 3))
        rigid[0, 0] = rigid[1, 1] = 1.0
        rigid[2:, 2] = 1.0
        modes = (jacobian @ rigid).reshape(-1, 3)
        mass = (self.mass @ (jacobian @ rigid)).reshape(-1, 3)
        bent = (self.mass @ (jacobian @ shape)[:, :, None])[:, :, 0]
        return np.asarray(
            shape + rigid @ np.linalg.solve(modes.T @ mass, modes.T @ (momentum - bent).ravel())
        )


def impulsive_drag(reynolds: int, cells: int, end: float) -> tuple[Array, Array]:
    """Return times Ut/R and drag coefficients of a cylinder of diameter 1 in a stream of 1."""
    h = 1.0 / cells
    x, y = edges(-10.0, 12.0, (-0.8, 1.6), h, 1.05), edges(-10.0, 10.0, (-0.8, 0.8), h, 1.05)
    grid = Grid(x, y)
    flow = Flow(grid, 1.0 / reynolds, "slip", inlet=np.ones(grid.ny))
    flow.u[:] = 1.0
    body = Immersed(flow, 1.0)
    body.add_circle(0.0, 0.0, 0.5)
    dt = 0.15 * h
    drag = []
    for _ in range(round(0.5 * end / dt)):
        body.step(dt)
        drag.append(2.0 * body.fixed_impulse[0] / dt)
    return 2.0 * dt * (np.arange(len(drag)) + 0.5), np.array(drag)


def impulsive(finest: float) -> tuple[str, str]:
    """Return the table of drag coefficients after an impulsive start, and their deviations."""
    rows, deviations = [], []
    for reynolds, (cells, published) in IMPULSIVE.items():
        count = round(cells / finest)
        times, drag = impulsive_drag(reynolds, count, published[-1][0] + 0.1)
        for moment, value in published:
            here = float(np.interp(moment, times, drag))
            off = here / value - 1.0
            deviations.append(off)
            rows.append(
                [
                    str(reynolds),
                    str(count),
                    f"{moment:g}",
                    f"{value:.3f}",
                    f"{here:.3f}",
                    f"{off:+.1%}" + (" ✓" if abs(off) <= 0.03 else ""),
                ]
            )
            progress(*rows[-1])
    count = sum(abs(off) <= 0.03 for off in deviations)
    number = f"{min(deviations):+.1%} to {max(deviations):+.1%}, {count} of {len(rows)} within 3%"
    return table("Re | cells across | Ut/R | published | here | deviation", rows), number


def undulate(cells: int, periods: float = PERIODS) -> Array:
    """Return the mean speeds of an eel-like swimmer in each period [lengths per period].

    cells: number of cells along its length
    """
    h, segments = 1.0 / cells, 50

    def half_width(s: Array) -> Array:
        front = np.sqrt(np.maximum(0.08 * s - s * s, 0.0))
        rear = np.where(s < 0.95, 0.04 - 0.03 * (s - 0.04) / 0.91, 0.01 * (1.0 - s) / 0.05)
        return np.asarray(np.where(s < 0.04, front, rear))

    points = np.linspace(0.0, 1.0, segments + 1)

    def angle(t: float) -> Array:
        """Return the angle of the midline, whose sine is the slope ∂y/∂s."""
        ramp = 0.5 * (1.0 - math.cos(math.pi * min(t, 1.0)))
        phase, reach = 2.0 * np.pi * (points - t), points + 0.03125
        slope = np.sin(phase) + 2.0 * np.pi * reach * np.cos(phase)
        return np.asarray(np.arcsin(0.125 / 1.03125 * ramp * slope))

    beam = Beam(1.0, half_width, np.ones_like, segments, h)
    beam.q[0] = -0.5
    x, y = edges(-5.0, 5.0, (-0.65, 0.65), h, 1.04), edges(-2.0, 2.0, (-0.3, 0.3), h, 1.06)
    flow = Flow(Grid(x, y), UNDULATION_VISCOSITY, "slip")
    dt = 1.0 / math.ceil(1.0 / (0.3 * h))
    body = GivenBody(flow, 1.0, beam, lambda t: (angle(t) - angle(t - dt)) / dt)
    travelled, starts = 0.0, [0.0]
    for step in range(1, round(periods / dt) + 1):
        body.step(dt)
        places, _ = beam.shape(beam.q)
        w = flow.grid_velocity
        travelled += dt * w[0]
        target = beam.share @ body.velocity[:, 0] + RECENTRE_RATE * (
            places[:, 0].min() + places[:, 0].max()
        )
        w[0] += dt / (10.0 * FOLLOW_TIME) * (target - w[0])
        w[1] = RECENTRE_RATE * 0.5 * (places[:, 1].min() + places[:, 1].max())
        if step % round(1.0 / dt) == 0:
            starts.append(travelled + float(beam.share @ places[:, 0] - beam.share @ beam.X + 0.5))
    return -np.diff(starts)


def anguilliform(finest: float) -> tuple[str, str]:
    """Return the table of speeds in each period, and the last one."""
    rows = []
    for cells in (100, 200, 400):
        cells = round(cells / finest)
        rows.append([str(cells), *(f"{speed:.3f}" for speed in undulate(cells))])
        progress(*rows[-1])
    heads = " | ".join(f"period {k}" for k in range(1, PERIODS + 1))
    number = f"{rows[-1][0]} cells: {rows[-1][-1]}"
    return table(f"cells along the body | {heads}", rows), number


def rigid_drag(cell: float, step: float, end: float) -> float:
    """Return the drag coefficient of the default fish, straight and at rest, at the time `end`.

    It refers to the length, and is the mean of the last quarter of the time.
    """
    settings = load(SWIMMER, numerics(cell, step)).swimmer
    template = Fish(settings)
    grid, beam = template.flow.grid, build_beam(settings)
    beam.q[0] = -0.5 * settings.body.length
    flow = Flow(grid, settings.water.viscosity, "slip", inlet=np.full(grid.ny, STREAM))
    flow.u[:] = STREAM
    body = GivenBody(flow, settings.water.density, beam)
    force = []
    for _ in range(round(end / step)):
        body.step(step)
        force.append(-float(body.force[:, 0].sum()))
    last = float(np.mean(force[-len(force) // 4 :]))
    return last / (0.5 * settings.water.density * STREAM**2 * settings.body.length)


def numerics(cell: float, step: float) -> list[str]:
    """Return the configuration of a grid."""
    keys = f"swimmer.numerics.cell={cell:g}", f"swimmer.numerics.step={step:g}"
    return [f"tick={10 * step:g}", *keys]


def rigid(finest: float) -> tuple[str, str]:
    """Return the table of drag coefficients of the rigid fish, and their last change."""
    rows: list[list[str]] = []
    before = None
    for cell, step in ((1e-3, 5e-4), (5e-4, 4e-4), (2.5e-4, 2e-4)):
        drag = rigid_drag(finest * cell, finest * step, 2.0)
        change = "" if before is None else f"{drag / before - 1.0:+.1%}"
        rows.append([f"{1e3 * finest * cell:g} mm", f"{drag:.4f}", change])
        before = drag
        progress(*rows[-1])
    return table("cells | drag coefficient | change", rows), rows[-1][-1]


FLOWS = {"impulsive": impulsive, "anguilliform": anguilliform, "rigid": rigid}
