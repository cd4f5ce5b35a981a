"""Policies and controllers on the same fish: who swims best, and how square is the command?"""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from statistics import fmean
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.config import Config, Start
from fishd.control.reporting import Publisher
from fishd.core.signals import Tick
from fishd.lab.compare.contestants import Contestant, build, parse, refusal
from fishd.lab.compare.seeing import SeeingController, may_see_pictures
from fishd.lab.ranking import (
    Candidate,
    complexity,
    format_choice,
    format_ratio,
    half_width,
    percent,
    rank,
    ratio,
)
from fishd.lab.simulation import KeepingPublisher, Report, VirtualRun, check_whole_beat, judge
from fishd.lab.statistics import mean_ci95

TRACE = 3.0
"""How much of the end of a run a picture shows [s]."""
_BEAT = 2.0
"""How much more is kept, so that there is an upward reversal to begin with [s]."""


class Trace(NamedTuple):
    """The end of a run, tick by tick."""

    time: list[float]  # s, 0 at the end
    command: list[float]  # φ_c applied from `time` on, rad
    thrust: list[float]  # F_x as measured, mean over the tick before `time`, N
    fin: list[float]  # true α at `time`, rad; NaN where nobody knows it


class Standing(Struct, frozen=True, kw_only=True):
    """How a contestant did: means over its runs."""

    contestant: str
    controller: str
    parameters: dict[str, Any]
    thrust: float
    """[N]"""
    error: float | None
    """Half of its 95 % interval [N]; None for one run in simulation, which has no error."""
    frequency: float
    """[Hz]"""
    fullness: float
    """Mean |φ_c|/Φ."""
    squareness: float
    """Mean |φ_c| over the rms of φ_c: square 1, sine 0.900, triangle 0.866."""
    thrusts: list[float]
    """Of each run [N]."""
    relative_thrust: float | None = None
    """Thrust over that of the best square wave, which is known of a simulated fish only."""
    faults: list[str] = []
    """Why runs ended in mode fault, if any did."""
    fallbacks: list[str] = []
    """Why another controller took over in runs, if one did; the figures are those of both."""
    runs: list[Report] = []
    """Of a simulated fish."""
    power: float | None = None
    """Electrical power of the servo [W]; None where it is not known."""
    thrust_per_watt: float | None = None
    """[N/W]"""
    thrust_per_watt_error: float | None = None
    """Half of its 95 % interval [N/W]; None for one run in simulation."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval that the calibration leaves to the thrust [N].

    None in simulation, where the thrust is the true one, and where it is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `error` and `calibration_ci95` together [N]."""
    thrust_per_watt_total_ci95: float | None = None
    """As `total_ci95`, of the thrust for each watt [N/W]."""


def compare(
    config: Config,
    contestants: Iterable[Contestant | str],
    seconds: float = 60.0,
    settle: float = 10.0,
    runs: int = 1,
    progress: Callable[[float], None] = lambda seconds: None,
    camera: SimulatedCameraSettings | None = None,
) -> tuple[list[Standing], list[Trace]]:
    """Let each swim the fish of `config`; standings and last traces, in the order given.

    contestants: texts are parsed: see `parse`
    runs: each contestant swims so many times, with noise of seed, seed + 1, ...
    progress: called with the time that has been swum [s]
    camera: what shows the fish to policies that see it; by default a good one

    Raises `ParameterError` (`PolicyError` for a file that is not a policy for this fish) and
    `UnknownController`, before anything swims; `ParameterError` also where a run has no whole beat.
    """
    chosen = [parse(one) if isinstance(one, str) else one for one in contestants]
    for contestant in chosen:
        if error := refusal(config, contestant):
            raise error
    seen = camera or SimulatedCameraSettings()
    standings, traces, swum = [], [], count(1)
    for contestant in chosen:
        reports = []
        for run in range(runs):
            noise = replace(config.simulation, seed=config.simulation.seed + run)
            fish = replace(config, simulation=noise)
            light = replace(seen, seed=seen.seed + run)
            end = _End(config.tick)
            report = swim(fish, contestant, seconds, settle, end, light)
            check_whole_beat(report, seconds, settle)
            reports.append(report)
            progress(next(swum) * seconds)
        standings.append(_standing(contestant.label, reports))
        traces.append(trace(end.ticks))
    return standings, traces


def swim(
    config: Config,
    contestant: Contestant,
    seconds: float,
    settle: float,
    publisher: Publisher,
    camera: SimulatedCameraSettings,
) -> Report:
    """Let one swim the fish of `config` once, from rest.

    publisher: gets each tick
    camera: what shows the fish to a policy that sees it

    Raises as `compare` does.
    """
    controller = build(contestant, replace(config.limits, virtual=True), camera)
    watch = controller.watch if isinstance(controller, SeeingController) else _nothing
    fish = replace(config, start=Start())
    return judge(fish, contestant.controller, controller, seconds, settle, publisher, watch)


def _nothing(_: VirtualRun) -> None:
    """No camera is needed."""


def trace(ticks: Sequence[Tick]) -> Trace:
    """As much of the end of these ticks as a picture needs."""
    end = ticks[-1].t
    shown = [tick for tick in ticks if tick.t >= end - TRACE - _BEAT - 1e-6]
    return Trace(
        [tick.t - end for tick in shown],
        [tick.phi_c for tick in shown],
        [tick.fx for tick in shown],
        [tick.alpha if isinstance(tick.alpha, float) else math.nan for tick in shown],
    )


def _standing(label: str, reports: list[Report]) -> Standing:
    thrusts = [report.mean_thrust for report in reports]
    powers = [report.mean_power for report in reports if report.mean_power is not None]
    per_watt = [report.mean_thrust / report.mean_power for report in reports if report.mean_power]
    return Standing(
        contestant=label,
        controller=reports[0].controller,
        parameters=reports[0].parameters,
        thrust=fmean(thrusts),
        error=mean_ci95(thrusts),
        thrusts=thrusts,
        relative_thrust=fmean(report.relative_thrust for report in reports),
        frequency=fmean(report.frequency for report in reports),
        fullness=fmean(report.fullness for report in reports),
        squareness=fmean(report.squareness for report in reports),
        faults=[report.reason.message for report in reports if report.reason],
        fallbacks=[report.fallback.message for report in reports if report.fallback],
        runs=reports,
        power=fmean(powers) if powers else None,
        thrust_per_watt=fmean(per_watt) if per_watt else None,
        thrust_per_watt_error=mean_ci95(per_watt),
    )


class Verdict(NamedTuple):
    """Which contestant thrusts most, as far as that is known."""

    sentence: str
    best: tuple[str, ...]
    """Those that may be the best one, the chosen one first; empty where no interval is known."""


def judge_standings(standings: Sequence[Standing], is_random: bool = True) -> Verdict | None:
    """Return the verdict on contestants; None where there are not two to compare.

    One whose run ended in a fault, or that another controller took over from, is left out of it.

    is_random: whether the forces of a simulated rig depend on the seed, as `is_random` of its
        settings says; a single run without noise is exact
    """
    fair = [each for each in standings if not each.faults and not each.fallbacks]
    if len(fair) < 2:
        return None
    if any(each.error is None and _depends_on_seed(each, is_random) for each in fair):
        return Verdict("none: a single run with noise has no interval; use --runs 5", ())
    found = [_candidate(each) for each in fair]
    ranking = rank(found)
    names = tuple(each.name for each in ranking.undecided)
    if not ranking.is_decided:
        return Verdict(format_choice(names, names[0], ranking.reason), names)
    best, following = sorted(found, key=lambda each: -each.thrust)[:2]
    pairs = len(found) * (len(found) - 1) // 2
    widths = [half_width(each, pairs) for each in (best, following)]
    share = ratio(best.thrust, widths[0], following.thrust, widths[1])
    if share is None:
        return Verdict(f"{names[0]} wins: no other one has a thrust above zero", names)
    shown = format_ratio(share) if any(widths) else f"exactly {percent(share[0])}"
    return Verdict(f"{names[0]} wins: it thrusts {shown} of {following.name}, the next one", names)


def _depends_on_seed(standing: Standing, is_random: bool) -> bool:
    """Return True where another run would differ: a given wave swims the same in any noise."""
    sees = standing.controller == "ppo" and may_see_pictures(standing.parameters.get("policy"))
    return sees or (is_random and complexity(standing.controller) > 0)


def _candidate(standing: Standing) -> Candidate:
    error = standing.error or 0.0
    by_runs = mean_ci95(standing.thrusts)
    return Candidate(
        standing.contestant,
        standing.thrust,
        error,
        complexity(standing.controller),
        len(standing.thrusts) - 1 if by_runs is not None and error <= by_runs else math.inf,
    )


class _End(KeepingPublisher):
    """A publisher that keeps the latest ticks."""

    def __init__(self, tick: float) -> None:
        super().__init__()
        self._most = max(2, round((TRACE + _BEAT) / tick) + 1)

    def tick(self, tick: Tick) -> None:
        """Keep it; forget the oldest from time to time."""
        super().tick(tick)
        if len(self.ticks) > 2 * self._most:
            del self.ticks[: -self._most]
