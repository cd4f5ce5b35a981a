"""Policies and controllers on the same fish: who swims best, and how square is the command?"""

import statistics
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.controllers import registry
from fishd.controllers.policy import library
from fishd.core import strict_yaml
from fishd.core.errors import FishdError, ParameterError, PolicyError, UnknownController
from fishd.core.schema import names_file, nearest
from fishd.core.signals import Event, Tick
from fishd.simulation import Report, judge
from fishd.virtual.plant.optimum import SteadyState, square_wave

TRACE = 3.0
"""How much of the end of a run a picture shows [s]."""
_BEAT = 2.0
"""How much more is kept, so that there is an upward reversal to begin with [s]."""
_GRID_HZ = (0.2, 10.0)
"""Whole-tick square waves are sought between these frequencies."""


class Contestant(NamedTuple):
    """A controller with its parameters, and what people call it."""

    label: str
    controller: str
    parameters: dict[str, Any]


class Trace(NamedTuple):
    """The end of a run, tick by tick."""

    time: list[float]  # s, 0 at the end
    command: list[float]  # φ_c applied from `time` on, rad
    thrust: list[float]  # F_x as measured, mean over the tick before `time`, N
    fin: list[float]  # true α at `time`, rad


class Standing(Struct, frozen=True, kw_only=True):
    """How a contestant did: medians over its runs, which differ in the noise of the sensor."""

    contestant: str
    controller: str
    parameters: dict[str, Any]
    efficiency: float
    """Thrust over that of the best square wave."""
    lowest_efficiency: float
    highest_efficiency: float
    thrust: float
    """[N]"""
    frequency: float
    """[Hz]"""
    fullness: float
    """Mean |φ_c|/Φ."""
    squareness: float
    """Mean |φ_c| over the rms of φ_c: square 1, sine 0.900, triangle 0.866."""
    faults: list[str]
    """Why runs ended in mode fault, if any did."""
    fallbacks: list[str]
    """Why another controller took over in runs, if one did; the figures are those of both."""
    runs: list[Report]


def parse(text: str) -> Contestant:
    """`swing:C=0.6`, `square:frequency=1.7,amplitude=0.3`, the name of a policy, a policy file.

    Raises `ParameterError`.
    """
    name, _, values = text.partition(":")
    if name == "remote":
        raise ParameterError(
            "remote: its agent is another program, which can swim a fishd but not be compared here"
        )
    if name not in registry.names():
        if not (names_file(text, library.SUFFIX) or text in library.names()):
            hint = nearest(name, [*registry.names(), *library.names()])
            raise ParameterError(
                f"'{name}' is not a controller, named policy or {library.SUFFIX} file; {hint}"
            )
        return Contestant(text, "ppo", {"policy": text})
    parameters = {}
    for pair in filter(None, values.split(",")):
        key, equals, value = pair.partition("=")
        if not (key and equals and value):
            raise ParameterError(f"{text}: '{pair}' is not valid: NAME=VALUE is needed")
        try:
            parameters[key] = strict_yaml.parse(value, key).data
        except strict_yaml.YamlProblem as problem:
            raise ParameterError(f"{text}: {problem}") from None
    return Contestant(text, name, parameters)


def best_on_grid(config: Config) -> SteadyState:
    """The best square wave whose half periods are whole ticks.

    No waveform in a loop does better, but for waves that alternate between two half periods.
    """
    lowest, highest = _GRID_HZ
    fewest = max(1, round(0.5 / highest / config.tick))
    most = max(fewest, round(0.5 / lowest / config.tick))
    waves = (
        square_wave(config.plant, config.amplitude_limit, 0.5 / (ticks * config.tick))
        for ticks in range(fewest, most + 1)
    )
    return max(waves, key=lambda wave: wave.thrust)


def default_contestants(config: Config) -> list[Contestant]:
    """The best square wave on the grid of ticks, `swing`, and the named policies that fit."""
    best = best_on_grid(config).frequency
    found = [
        Contestant(f"square {best:.3f} Hz", "square", {"frequency": best}),
        Contestant("swing", "swing", {}),
    ]
    policies = (Contestant(name, "ppo", {"policy": name}) for name in library.names())
    found += [policy for policy in policies if not refusal(config, policy)]
    return found


def refusal(config: Config, contestant: Contestant) -> FishdError | None:
    """Why one cannot swim the fish of `config`, such as a policy for another amplitude, or None."""
    limits = replace(config.limits, virtual=True)
    try:
        registry.create(contestant.controller, contestant.parameters, limits).close()
    except (ParameterError, PolicyError, UnknownController) as error:
        return error
    return None


def compare(
    config: Config, contestants: Sequence[Contestant], seconds: float, settle: float, runs: int = 1
) -> tuple[list[Standing], list[Trace]]:
    """Let each swim the fish of `config`; standings and last traces, in the order given.

    runs: each contestant swims so many times, with noise of seed, seed + 1, ...
    Raises `ParameterError` (`PolicyError` for a file that is not a policy for this fish) and
    `UnknownController`, before anything swims.
    """
    for contestant in contestants:
        if error := refusal(config, contestant):
            raise error
    limits = replace(config.limits, virtual=True)
    standings, traces = [], []
    for label, name, parameters in contestants:
        reports = []
        end = _End(config.tick)
        for run in range(runs):
            noise = replace(config.simulation, seed=config.simulation.seed + run)
            fish = replace(config, simulation=noise, start=Start())
            controller = registry.create(name, parameters, limits)
            reports.append(judge(fish, name, controller, seconds, settle, end))
        standings.append(_standing(label, reports))
        traces.append(end.trace())
    return standings, traces


def _standing(label: str, reports: list[Report]) -> Standing:
    def median(values: Iterable[float]) -> float:
        return float(statistics.median(values))

    efficiencies = [report.efficiency for report in reports]
    return Standing(
        contestant=label,
        controller=reports[0].controller,
        parameters=reports[0].parameters,
        efficiency=median(efficiencies),
        lowest_efficiency=min(efficiencies),
        highest_efficiency=max(efficiencies),
        thrust=median(report.mean_thrust for report in reports),
        frequency=median(report.frequency for report in reports),
        fullness=median(report.fullness for report in reports),
        squareness=median(report.squareness for report in reports),
        faults=[report.reason.message for report in reports if report.reason],
        fallbacks=[report.fallback.message for report in reports if report.fallback],
        runs=reports,
    )


class _End:
    """A publisher that keeps the latest ticks."""

    def __init__(self, tick: float) -> None:
        self._ticks: deque[Tick] = deque(maxlen=max(2, round((TRACE + _BEAT) / tick) + 1))

    def tick(self, tick: Tick) -> None:
        """Keep it, and forget the oldest."""
        self._ticks.append(tick)

    def event(self, event: Event) -> None:
        """Drop: a fault is in the report."""

    def trace(self) -> Trace:
        ticks = self._ticks
        return Trace(
            [tick.t - ticks[-1].t for tick in ticks],
            [tick.phi_c for tick in ticks],
            [tick.fx for tick in ticks],
            [tick.alpha if isinstance(tick.alpha, float) else 0.0 for tick in ticks],
        )
