"""Flow past a fixed circular cylinder at a Reynolds number of 100, far from any wall.

The published values are those collected by Qu, Norberg, Davidson, Peng and Wang, J. Fluids Struct.
39, 2013, pp. 347–370, doi:10.1016/j.jfluidstructs.2013.02.007, table 1.
"""

import numpy as np

from bench.swimmer_flag import crossings
from common.report import progress, table
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import Grid, edges
from fishd.virtual.swimmer.immersed import Immersed

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


def cylinder(finest: float) -> str:
    """Return the table of Strouhal number and drag at Re = 100."""
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
    return table("source | Strouhal number | mean drag | outside of the published values by", rows)


def outside(value: float, band: tuple[float, float]) -> float:
    """Return the relative distance from the nearest published value; 0 between them."""
    nearest = min(max(value, band[0]), band[1])
    return value / nearest - 1.0
