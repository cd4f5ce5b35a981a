"""Fish other than the configured one: anywhere in the range of a randomisation, or at its edges.

A policy that is to swim an unknown fish is trained on the former and evaluated on the latter.
"""

import math
from collections.abc import Callable

import numpy as np
from msgspec.structs import replace

from fishd.config import Config
from fishd.learning.settings import Randomisation

_VARIED = ("omega0", "xi", "servo_speed", "coupling")
"""Parameters of the plant that a randomisation has a share for."""


def drawn(config: Config, spread: Randomisation, seed: int) -> Config:
    """A fish and a rig from anywhere in the range."""
    draw = np.random.default_rng(seed)
    return _varied(config, spread, lambda: draw.uniform(-1.0, 1.0), int(draw.integers(2**31)))


def at_edge(config: Config, spread: Randomisation, seed: int) -> Config:
    """A fish and a rig with every varied parameter at one end of its range or the other."""
    draw = np.random.default_rng(seed)
    return _varied(config, spread, lambda: float(draw.choice((-1.0, 1.0))), config.simulation.seed)


def _varied(
    config: Config, spread: Randomisation, place: Callable[[], float], noise_seed: int
) -> Config:
    """place: draws for one parameter its place in the range, from -1 to 1"""

    def varied(value: float, share: float) -> float:
        return value * math.exp(place() * math.log1p(share))

    plant, rig = config.plant, config.simulation
    changed = {name: varied(getattr(plant, name), getattr(spread, name)) for name in _VARIED}
    noise = varied(rig.noise, spread.noise)
    offset_y = rig.offset_y + spread.offset * place()
    return replace(
        config,
        plant=replace(plant, **changed),
        simulation=replace(rig, noise=noise, offset_y=offset_y, seed=noise_seed),
    )
