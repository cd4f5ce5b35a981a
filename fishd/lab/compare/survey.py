"""Survey of contestants on many simulated fish, to test how well they generalise."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from msgspec import Struct

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config
from fishd.core.beats import Reversals
from fishd.core.signals import Event, Tick
from fishd.lab.compare.comparison import swim
from fishd.lab.compare.contestants import Contestant, refusal
from fishd.lab.other_fish import OtherFish


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
    shaken: float
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


class ReversalTimes:
    """A publisher that stores the times of reversals of the instruction angle."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._reversals = Reversals()

    def tick(self, tick: Tick) -> None:
        """Store the time of a reversal."""
        if self._reversals.add(tick.phi_c):
            self.times.append(tick.t)

    def event(self, event: Event) -> None:
        """Drop an event."""

    def longest(self, apart: float) -> float:
        """Return the length of the longest series of reversals less than `apart` apart [s]."""
        longest = start = 0.0
        for previous, current in pairwise(self.times):
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
            reversals = ReversalTimes()
            report = swim(config, contestant, seconds, settle, reversals, camera_settings)
            rows.append(
                FishResult(
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
        surveys.append(
            ContestantSurvey(contestant=label, controller=name, parameters=parameters, fish=rows)
        )
    return surveys
