"""Fish that differ from the model as those of real rigs do: one by one, and in all of it at once.

What is to swim a fish that nobody has measured should do well on all of them.
"""

import math
import random
from collections.abc import Callable
from typing import NamedTuple

from fishd.virtual.plant.parameters import PlantParameters

FIRST_SEED = 300
"""Of the harsh fish; nothing in fishd was trained or chosen with these."""
HARSH_FISH = 20


class OtherFish(NamedTuple):
    """A fish, by the keys in which it differs from the configured one."""

    name: str
    overrides: tuple[str, ...]


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
"""What a real rig does, one at a time."""


def harsh(seed: int) -> OtherFish:
    """A fish and a rig with all of it, in random sizes."""
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
    """Return a random fish on a clean rig: it differs from `harsh` in what the rig adds.

    The fish have the ranges of `harsh`. The servo delay is 20 ms at most; there is no backlash, no
    dead zone, no servo reaction, no offset, no drift and no rotation, and the noise is the default.
    """
    uniform = random.Random(seed).uniform
    plant = {**_random_fish(uniform), "servo_delay": uniform(0.0, 0.02)}
    return _other_fish(f"mild {seed}", plant, {"seed": seed})


def harsh_fish() -> tuple[OtherFish, ...]:
    """The twenty that policies are judged by."""
    return tuple(harsh(FIRST_SEED + k) for k in range(HARSH_FISH))


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
