"""One contestant after the other on many fish: does it carry over to those that differ?"""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from msgspec import Struct

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.config import Config
from fishd.core.beats import Reversals
from fishd.core.signals import Event, Tick
from fishd.lab.compare.comparison import swim
from fishd.lab.compare.contestants import Contestant, refusal
from fishd.lab.other_fish import OtherFish


class Swum(Struct, frozen=True, kw_only=True):
    """How a contestant swam a fish."""

    fish: str
    overrides: tuple[str, ...]
    """The keys in which it differs."""
    relative_thrust: float
    """Thrust over that of this fish's own best square wave."""
    thrust: float
    """[N]"""
    frequency: float
    """[Hz]"""
    shaken: float
    """Longest stretch of reversals in consecutive ticks [s]."""
    fallback: str | None
    """Why another controller took over, if one did; the figures are those of both."""
    fault: str | None
    """Why the run ended in mode fault, if it did."""


class Surveyed(Struct, frozen=True, kw_only=True):
    """A contestant on all fish."""

    contestant: str
    controller: str
    parameters: dict[str, Any]
    fish: list[Swum]

    @property
    def median(self) -> float:
        """Of the relative thrusts."""
        return median(swum.relative_thrust for swum in self.fish)

    @property
    def worst(self) -> Swum:
        """On the fish that it is worst on."""
        return min(self.fish, key=lambda swum: swum.relative_thrust)


class ReversalTimes:
    """Publisher that notes when the instruction angle changed its side."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._reversals = Reversals()

    def tick(self, tick: Tick) -> None:
        """Note a reversal."""
        if self._reversals.add(tick.phi_c):
            self.times.append(tick.t)

    def event(self, event: Event) -> None:
        """Drop."""

    def longest(self, apart: float) -> float:
        """The longest stretch of reversals that follow within less than a time [s]."""
        longest = begun = 0.0
        for before, now in pairwise(self.times):
            begun = begun or before
            if now - before < apart:
                longest = max(longest, now - begun)
            else:
                begun = 0.0
        return longest


def survey(
    configs: Sequence[tuple[OtherFish, Config]],
    contestants: Iterable[Contestant],
    seconds: float,
    settle: float,
    progress: Callable[[float], None] = lambda seconds: None,
    camera: SimulatedCameraSettings | None = None,
) -> list[Surveyed]:
    """Let each contestant swim each fish once, in virtual time.

    configs: the fish, and each as a configuration
    seconds, settle: as for `fishd.lab.simulation.simulate` [s]
    progress: called with the time that has been swum [s]
    camera: what shows the fish to policies that see it; by default a good one

    Raises `ParameterError` (`PolicyError` for a file that is not a policy for these fish) and
    `UnknownController`, before a contestant swims.
    """
    seen, found, done = camera or SimulatedCameraSettings(), [], 0.0
    for contestant in contestants:
        if error := refusal(configs[0][1], contestant):
            raise error
        rows = []
        for fish, config in configs:
            reversals = ReversalTimes()
            report = swim(config, contestant, seconds, settle, reversals, seen)
            rows.append(
                Swum(
                    fish=fish.name,
                    overrides=fish.overrides,
                    relative_thrust=report.relative_thrust,
                    thrust=report.mean_thrust,
                    frequency=report.frequency,
                    shaken=reversals.longest(1.5 * config.tick),
                    fallback=report.fallback.message if report.fallback else None,
                    fault=report.reason.message if report.reason else None,
                )
            )
            done += seconds
            progress(done)
        label, name, parameters = contestant
        found.append(Surveyed(contestant=label, controller=name, parameters=parameters, fish=rows))
    return found
