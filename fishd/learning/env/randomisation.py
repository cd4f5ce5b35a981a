"""Fish other than the configured one: in the range of a randomisation, or at its edges.

A policy that is to swim a fish that nobody has measured learns on the former, and is judged on the
latter.
"""

import math
from collections.abc import Callable

import numpy as np
from msgspec.structs import replace

from fishd.config import Config
from fishd.learning.settings import Randomisation


def drawn(config: Config, spread: Randomisation, seed: int) -> Config:
    """A fish and a rig from anywhere in the range."""
    draw = np.random.default_rng(seed)
    return _varied(config, spread, lambda: draw.uniform(-1.0, 1.0), int(draw.integers(2**31)))


def at_edge(config: Config, spread: Randomisation, seed: int) -> Config:
    """A fish and a rig of which everything that varies is at one end of its range or the other."""
    draw = np.random.default_rng(seed)
    return _varied(config, spread, lambda: float(draw.choice((-1.0, 1.0))), config.simulation.seed)


def _varied(
    config: Config, spread: Randomisation, place: Callable[[], float], noise_seed: int
) -> Config:
    """place: says for each parameter where in its range it is, from -1 to 1."""

    def varied(value: float, share: float) -> float:
        return value * math.exp(place() * math.log1p(share))

    plant, rig = config.plant, config.simulation
    return replace(
        config,
        plant=replace(
            plant,
            omega0=varied(plant.omega0, spread.omega0),
            xi=varied(plant.xi, spread.xi),
            servo_speed=varied(plant.servo_speed, spread.servo_speed),
            coupling=varied(plant.coupling, spread.coupling),
        ),
        simulation=replace(
            rig,
            noise=varied(rig.noise, spread.noise),
            offset_y=rig.offset_y + spread.offset * place(),
            seed=noise_seed,
        ),
    )
