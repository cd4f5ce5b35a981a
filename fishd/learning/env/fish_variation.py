"""Random fish and rigs that differ from the configured ones, to train and to evaluate on."""

import math
from collections.abc import Callable

import numpy as np
from msgspec.structs import replace

from fishd.config import Config
from fishd.learning.settings import Randomisation

_FIRST_VARIED = ("omega0", "xi", "servo_speed", "coupling")
_LATER_VARIED = ("servo_lag", "thrust_coefficient", "lateral_drag")
"""Parameters of the plant that a randomisation has a share for, in the order of the draws: the
later ones are drawn after the noise and the offset."""
_INCREASED = ("servo_delay", "servo_dead_zone", "backlash")
"""Parameters of the plant that a randomisation increases by up to its value."""


def episode_fish(spread: Randomisation) -> Callable[[Config, int], Config] | None:
    """Return the function that draws the fish of an episode, or None if the fish do not vary."""
    if spread == Randomisation():
        return None
    return lambda config, seed: draw_fish(config, spread, seed)


def draw_fish(config: Config, spread: Randomisation, seed: int) -> Config:
    """Return a random fish and rig of the range, to train on for a fish that is not known."""
    random = np.random.default_rng(seed)
    if spread.fish:
        config = replace(config, plant=spread.fish[int(random.integers(len(spread.fish)))])
    return _vary(config, spread, lambda: random.uniform(-1.0, 1.0), int(random.integers(2**31)))


def draw_edge_fish(config: Config, spread: Randomisation, seed: int) -> Config:
    """Return a fish and rig with every varied parameter at one end of its range, to evaluate on.

    A list of fish is indexed by the seed, modulo its length.
    """
    random = np.random.default_rng(seed)
    if spread.fish:
        config = replace(config, plant=spread.fish[seed % len(spread.fish)])
    return _vary(config, spread, lambda: float(random.choice((-1.0, 1.0))), config.simulation.seed)


def _vary(
    config: Config, spread: Randomisation, place: Callable[[], float], noise_seed: int
) -> Config:
    """Return a varied configuration.

    place: draws the place of a parameter in its range, from -1 to 1
    """

    def vary(value: float, share: float) -> float:
        return value * math.exp(place() * math.log1p(share))

    plant, rig = config.plant, config.simulation
    changed = {name: vary(getattr(plant, name), getattr(spread, name)) for name in _FIRST_VARIED}
    noise = vary(rig.noise, spread.noise)
    offset_y = rig.offset_y + spread.offset * place()
    changed |= {name: vary(getattr(plant, name), getattr(spread, name)) for name in _LATER_VARIED}
    for name in _INCREASED:
        changed[name] = getattr(plant, name) + 0.5 * (1.0 + place()) * getattr(spread, name)
    changed["servo_reaction"] = plant.servo_reaction + spread.servo_reaction * place()
    rotation = rig.rotation + spread.rotation * place()
    changed["cable_slack"] = plant.cable_slack + 0.5 * (1.0 + place()) * spread.cable_slack
    return replace(
        config,
        plant=replace(plant, **changed),
        simulation=replace(rig, noise=noise, offset_y=offset_y, rotation=rotation, seed=noise_seed),
    )
