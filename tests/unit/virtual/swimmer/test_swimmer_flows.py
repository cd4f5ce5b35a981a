"""A swimmer that undulates like an eel, and swims freely, against published flows.

Gazzola, Chatelain, van Rees and Koumoutsakos, J. Comput. Phys. 230, 2011, pp. 7093–7114,
doi:10.1016/j.jcp.2011.04.025, equation 45, as set up in SophT (examples/2d_examples/
FishSwimmingCase, in its repository).
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

from fishd.virtual.swimmer.beam import Beam
from fishd.virtual.swimmer.fish import FOLLOW_TIME, RECENTRE_RATE
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.immersed import Immersed

VISCOSITY = 1.4e-4
"""Kinematic viscosity in lengths² per period."""


class GivenBody(Immersed):
    """Body whose shape is given at all times; its position and direction are free."""

    def __init__(
        self, flow: Flow, density: float, beam: Beam, rates: Callable[[float], Array]
    ) -> None:
        """rates: θ̇ of the beam's points at a time, without a turn of the whole"""
        super().__init__(flow, density, beam)
        self.time = 0.0
        self._rates = rates

    def _solve(
        self, beam: Beam, dt: float, jacobian: Array, momentum: Array, forces: Array | None
    ) -> Array:
        """Return the rates that keep the total momentum of the body in all rigid motions."""
        self.time += dt
        shape = np.zeros(beam.size)
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


def undulate(cells: int, periods: float) -> Array:
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
    flow = Flow(Grid(x, y), VISCOSITY, "slip")
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


def test_a_swimmer_that_undulates_like_an_eel_gathers_speed_as_it_did() -> None:
    """A tip through which water passed had 0.080 and 0.299, and with 400 cells 0.092 and 0.337."""
    assert undulate(100, 2.0) == pytest.approx([0.084, 0.308], rel=0.02)
