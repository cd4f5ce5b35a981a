"""Survey of contestants on many simulated fish, to test how well they generalise.

The fish differ from the model as real rigs do, in one respect or in all of them. A controller for
an unidentified fish should swim all of them well.
"""

import math
import random
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config
from fishd.core.beats import Reversals
from fishd.core.signals import Tick
from fishd.lab.compare.comparison import swim
from fishd.lab.compare.contestants import Contestant, refusal
from fishd.lab.simulation import KeepingPublisher
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


class FishResult(Struct, frozen=True, kw_only=True):
    """Result of a contestant on one fish."""

    fish: str
    overrides: tuple[str, ...]
    """Changes of the configuration, as KEY=VALUE."""
    relative_thrust: float
    """Thrust over that of the best square wave on this fish."""
    thrust: float
    """Mean thrust [N]."""
    frequency: float
    """Frequency of the tail beat [Hz]."""
    longest_chatter_s: float
    """Length of the longest series of reversals in consecutive ticks [s]."""
    fallback: str | None
    """Reason why the fallback took over; None if not. The results include its swimming."""
    fault: str | None
    """Reason why the run ended in mode fault; None if it did not."""


class ContestantSurvey(Struct, frozen=True, kw_only=True):
    """Results of a contestant on all fish."""

    contestant: str
    controller: str
    parameters: dict[str, Any]
    fish: list[FishResult]

    @property
    def median(self) -> float:
        """Median of the relative thrusts."""
        return median(result.relative_thrust for result in self.fish)

    @property
    def worst(self) -> FishResult:
        """Result on the fish of smallest relative thrust."""
        return min(self.fish, key=lambda result: result.relative_thrust)


def longest_chatter(ticks: Iterable[Tick], apart: float) -> float:
    """Return the length of the longest series of reversals less than `apart` apart [s]."""
    reversals = Reversals()
    times = [tick.time for tick in ticks if reversals.add(tick.phi_c)]
    longest = start = 0.0
    for previous, current in pairwise(times):
        start = start or previous
        if current - previous < apart:
            longest = max(longest, current - start)
        else:
            start = 0.0
    return longest


def survey(
    configs: Sequence[tuple[OtherFish, Config]],
    contestants: Iterable[Contestant],
    seconds: float,
    settle: float,
    progress: Callable[[float], None] = lambda seconds: None,
    camera: SimulatedCameraSettings | None = None,
) -> list[ContestantSurvey]:
    """Swim each fish once with each contestant, in virtual time.

    configs: the fish, each with its configuration
    seconds, settle: see `fishd.lab.simulation.simulate` [s]
    progress: called with the time swum by now [s]
    camera: settings of the camera for policies that see pictures; by default a good one

    Raises `ParameterError` (`PolicyError` for a file that is not a policy for these fish) and
    `UnknownController` before the first run of a contestant.
    """
    camera_settings, surveys, done = camera or SimulatedCameraSettings(), [], 0.0
    for contestant in contestants:
        if error := refusal(configs[0][1], contestant):
            raise error
        rows = []
        for fish, config in configs:
            publisher = KeepingPublisher()
            report = swim(config, contestant, seconds, settle, publisher, camera_settings)
            rows.append(
                FishResult(
                    fish=fish.name,
                    overrides=fish.overrides,
                    relative_thrust=report.relative_thrust,
                    thrust=report.mean_thrust,
                    frequency=report.frequency,
                    longest_chatter_s=longest_chatter(publisher.ticks, 1.5 * config.tick),
                    fallback=report.fallback.message if report.fallback else None,
                    fault=report.reason.message if report.reason else None,
                )
            )
            done += seconds
            progress(done)
        label, name, parameters = contestant
        surveys.append(
            ContestantSurvey(contestant=label, controller=name, parameters=parameters, fish=rows)
        )
    return surveys
