"""A fish in its tank: its energy is conserved, and without muscles it comes to rest."""

import numpy as np
import pytest
from rigs.coarse_swimmer import UNDAMPED, coarse

from fishd.virtual.swimmer.fish import Fish, Work


def swim(fish: Fish, seconds: float, frequency: float) -> None:
    """Swim with a square wave, or with relaxed muscles if the frequency is 0 Hz."""
    for _ in range(round(seconds / fish.dt)):
        fish.step((1.0 if fish.time * frequency % 1.0 < 0.5 else -1.0) if frequency else 0.0)


def kinetic_energy(fish: Fish) -> float:
    """Return the kinetic energy of all that moves on the grid, the body included [J/m]."""
    flow, grid = fish.flow, fish.flow.grid
    u, v = 0.5 * (flow.u[1:] + flow.u[:-1]), 0.5 * (flow.v[:, 1:] + flow.v[:, :-1])
    return float(500.0 * grid.dx @ (u**2 + v**2) @ grid.dy)


def compute_friction(fish: Fish, speed: float) -> float:
    """Return the drag coefficient of a straight fish, laminar, from that at a Re of 10⁴."""
    settings = fish.settings
    return 0.042 * np.sqrt(1e4 * settings.water.viscosity / (speed * settings.body.length))


@pytest.mark.slow
def test_a_fish_gives_the_water_what_its_muscles_give_and_friction_alone_slows_it() -> None:
    small_steps_and_tank = "numerics.step=0.001", "water.length=0.2", "water.width=0.15"
    settings = (f"swimmer.{setting}" for setting in small_steps_and_tank)
    fish = Fish(coarse(*settings, file=UNDAMPED).swimmer)
    swim(fish, 0.8, 2.5)
    before = np.array(fish.work)
    swim(fish, 1.2, 2.5)  # three beats; within one, the body stores energy or gives it back
    work = Work(*(np.array(fish.work) - before))
    assert 0.85 * work.muscles < work.water < work.muscles + work.steering
    assert abs(work.steering) < 0.01 * work.muscles
    speeds, left = [fish.motion().speed], [kinetic_energy(fish)]
    for _ in range(6):
        swim(fish, 2.0, 0.0)
        speeds.append(fish.motion().speed)
        left.append(kinetic_energy(fish))
    assert speeds[0] > 0.05
    assert left == sorted(left, reverse=True)
    assert left[2] < 0.2 * left[0]
    assert left[-1] < 0.03 * left[0]
    assert abs(fish.motion().tail_rate) < 0.005
    # m dU/dt = −½ ρ L C U², from 4 to 12 s after the last beat
    slowness = (1.0 / speeds[-1] - 1.0 / speeds[2]) / 8.0
    drag_coefficient = 2.0 * fish.beam.area / fish.beam.length * slowness
    friction = compute_friction(fish, float(np.sqrt(speeds[2] * speeds[-1])))
    assert drag_coefficient == pytest.approx(friction, rel=0.25)
