"""Simulated fish that differ from the model as real rigs do, in one respect or in all of them.

A controller for an unidentified fish should swim all of them well.
"""

import math
import random
from collections.abc import Callable
from typing import NamedTuple

from fishd.virtual.plant.parameters import PlantParameters

FIRST_SEED = 300
"""Seed of the first harsh fish; nothing in fishd was trained or selected with these fish."""
HARSH_FISH_COUNT = 20
"""Number of harsh fish."""


class OtherFish(NamedTuple):
    """A simulated fish, described by its differences from the configured one."""

    name: str
    overrides: tuple[str, ...]
    """Changes of the configuration, as KEY=VALUE."""


_MODEL = PlantParameters()
CHANGES = (
    OtherFish("none", ()),
    OtherFish("backlash 0.15 rad", ("plant.backlash=0.15",)),
    OtherFish("dead zone 0.15 rad", ("plant.servo_dead_zone=0.15",)),
    *(
        OtherFish(f"servo delay {ms} ms", (f"plant.servo_delay={ms / 1000}",))
        for ms in (20, 40, 80)
    ),
    OtherFish("servo reaction 6e-3 N s²/rad", ("plant.servo_reaction=6e-3",)),
    *(
        OtherFish(f"K_d × {times}", (f"plant.lateral_drag={times * _MODEL.lateral_drag}",))
        for times in (3, 10)
    ),
)
"""Fish with one imperfection of real rigs each."""


def harsh(seed: int) -> OtherFish:
    """Return a fish and a rig with all imperfections, of random sizes."""
    uniform = random.Random(seed).uniform
    plant = {
        **_random_fish(uniform),
        "backlash": uniform(0.0, 0.08),
        "servo_delay": uniform(0.0, 0.05),
        "servo_dead_zone": uniform(0.0, 0.03),
        "servo_reaction": uniform(-2e-3, 3e-3),
    }
    rig = {
        "noise": uniform(0.5e-3, 2e-3),
        "rotation": uniform(-0.17, 0.17),
        "drift": uniform(0.0, 5e-3),
        "offset_y": uniform(-0.02, 0.02),
        "offset_x": uniform(-0.02, 0.02),
        "seed": seed,
    }
    return _other_fish(f"harsh {seed}", plant, rig)


def mild(seed: int) -> OtherFish:
    """Return a random fish on a clean rig: it differs from `harsh` in the rig.

    The fish have the ranges of `harsh`. The servo delay is 20 ms at most. Backlash, dead zone,
    servo reaction, offset, drift and rotation are zero, and the noise is the default.
    """
    uniform = random.Random(seed).uniform
    plant = {**_random_fish(uniform), "servo_delay": uniform(0.0, 0.02)}
    return _other_fish(f"mild {seed}", plant, {"seed": seed})


def harsh_fish() -> tuple[OtherFish, ...]:
    """Return the twenty harsh fish on which policies are evaluated."""
    return tuple(harsh(FIRST_SEED + k) for k in range(HARSH_FISH_COUNT))


def _random_fish(uniform: Callable[[float, float], float]) -> dict[str, float]:
    """Return the keys of section plant that make a random fish and servo."""
    return {
        "omega0": uniform(8.0, 18.0),
        "xi": uniform(0.6, 1.8),
        "coupling": uniform(0.35, 0.6),
        "servo_speed": uniform(4.0, 9.0),
        "servo_lag": uniform(0.15, 0.4),
        "thrust_coefficient": _MODEL.thrust_coefficient * uniform(0.6, 1.6),
        "lateral_drag": _MODEL.lateral_drag * math.exp(uniform(math.log(0.5), math.log(3.0))),
    }


def _other_fish(name: str, plant: dict[str, float], simulation: dict[str, float]) -> OtherFish:
    """Return the fish with these keys in sections plant and simulation."""
    keys = [f"plant.{key}={value!r}" for key, value in plant.items()]
    keys += [f"simulation.{key}={value!r}" for key, value in simulation.items()]
    return OtherFish(name, tuple(keys))
