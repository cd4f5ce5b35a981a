"""Comparison of policies and controllers on the same simulated fish."""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from statistics import fmean
from typing import Any, NamedTuple

from msgspec import field
from msgspec.structs import replace

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config, Start
from fishd.core.signals import Publisher, Tick
from fishd.lab.compare.contestants import (
    Contestant,
    SeeingController,
    build,
    may_see_pictures,
    parse,
    refusal,
)
from fishd.lab.error_budget import Thrust
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

TRACE_S = 3.0
"""Length of the end of a run that a figure shows [s]."""
_MARGIN_S = 2.0
"""Further length that is stored, so that the figure can start at an upward reversal [s]."""


class Trace(NamedTuple):
    """The end of a run, tick by tick."""

    time: list[float]  # s, 0 at the end
    command: list[float]  # φ_c applied from `time` on, rad
    thrust: list[float]  # F_x as measured, mean over the tick before `time`, N
    fin: list[float]  # true α at `time`, rad; NaN where unknown


class Standing(Thrust, frozen=True, kw_only=True):
    """Result of a contestant, as means over its runs.

    In simulation the thrust is exact: a single run has no interval, and no calibration counts.
    """

    contestant: str
    controller: str
    parameters: dict[str, Any]
    frequency: float
    """Frequency of the tail beat [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    form_factor: float
    """Mean |φ_c| over the rms of φ_c: square 1, sine 0.900, triangle 0.866."""
    thrusts: list[float]
    """Thrust of each run [N]."""
    relative_thrust: float | None = None
    """Thrust over that of the best square wave; None if that is unknown, as for a real fish."""
    faults: list[str] = field(default_factory=list)
    """Reasons of runs that ended in mode fault."""
    fallbacks: list[str] = field(default_factory=list)
    """Reasons why the fallback took over in runs; the results include its swimming."""
    runs: list[Report] = field(default_factory=list)
    """Reports of the runs of a simulated fish; empty for a real fish."""


def compare(
    config: Config,
    contestants: Iterable[Contestant | str],
    seconds: float = 60.0,
    settle: float = 10.0,
    runs: int = 1,
    progress: Callable[[float], None] = lambda seconds: None,
    camera: SimulatedCameraSettings | None = None,
) -> tuple[list[Standing], list[Trace]]:
    """Swim the fish of `config` with each contestant; return standings and traces of last runs.

    contestants: contestants, or texts for `parse`
    runs: number of runs of each contestant, with noise of seed, seed + 1, ...
    progress: called with the time swum by now [s]
    camera: settings of the camera for policies that see pictures; by default a good one

    Raises `ParameterError` (`PolicyError` for a file that is not a policy for this fish) and
    `UnknownController` before the first run, and `ParameterError` for a run without a whole beat.
    """
    parsed = [parse(item) if isinstance(item, str) else item for item in contestants]
    for contestant in parsed:
        if error := refusal(config, contestant):
            raise error
    camera_settings = camera or SimulatedCameraSettings()
    standings, traces, run_count = [], [], count(1)
    for contestant in parsed:
        reports = []
        for run in range(runs):
            noise = replace(config.simulation, seed=config.simulation.seed + run)
            fish = replace(config, simulation=noise)
            camera_of_run = replace(camera_settings, seed=camera_settings.seed + run)
            latest_ticks = KeepingPublisher(max(2, round((TRACE_S + _MARGIN_S) / config.tick) + 1))
            report = swim(fish, contestant, seconds, settle, latest_ticks, camera_of_run)
            check_whole_beat(report, seconds, settle)
            reports.append(report)
            progress(next(run_count) * seconds)
        standing = _standing(contestant.label, reports)
        if not config.kind.is_of_plant():
            standing = replace(standing, relative_thrust=None)
        standings.append(standing)
        traces.append(trace(latest_ticks.ticks))
    return standings, traces


def swim(
    config: Config,
    contestant: Contestant,
    seconds: float,
    settle: float,
    publisher: Publisher,
    camera: SimulatedCameraSettings,
) -> Report:
    """Swim the fish of `config` once with a contestant, from rest; return the report.

    publisher: receiver of each tick
    camera: settings of the camera for a policy that sees pictures

    Raises the errors of `compare`.
    """
    controller = build(contestant, replace(config.limits, virtual=True), camera)
    watch = controller.watch if isinstance(controller, SeeingController) else _do_nothing
    fish = replace(config, start=Start())
    return judge(fish, contestant.controller, controller, seconds, settle, publisher, watch)


def _do_nothing(_: VirtualRun) -> None:
    """Do nothing, as no camera is needed."""


def trace(ticks: Sequence[Tick]) -> Trace:
    """Return the end of a run as a trace for figures."""
    end = ticks[-1].time
    kept = [tick for tick in ticks if tick.time >= end - TRACE_S - _MARGIN_S - 1e-6]
    return Trace(
        [tick.time - end for tick in kept],
        [tick.phi_c for tick in kept],
        [tick.fx for tick in kept],
        [tick.alpha if isinstance(tick.alpha, float) else math.nan for tick in kept],
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
        thrust_ci95=mean_ci95(thrusts),
        thrusts=thrusts,
        relative_thrust=fmean(report.relative_thrust for report in reports),
        frequency=fmean(report.frequency for report in reports),
        fullness=fmean(report.fullness for report in reports),
        form_factor=fmean(report.form_factor for report in reports),
        faults=[report.reason.message for report in reports if report.reason],
        fallbacks=[report.fallback.message for report in reports if report.fallback],
        runs=reports,
        power=fmean(powers) if powers else None,
        thrust_per_watt=fmean(per_watt) if per_watt else None,
        thrust_per_watt_ci95=mean_ci95(per_watt),
    )


class Verdict(NamedTuple):
    """The contestants of largest thrust, with regard to the intervals."""

    sentence: str
    best: tuple[str, ...]
    """Labels of those that may be the best, the chosen one first; empty without intervals."""


def judge_standings(standings: Sequence[Standing], is_random: bool = True) -> Verdict | None:
    """Return the verdict on contestants; None for fewer than two.

    Contestants with a run that ended in a fault or in a fallback are left out.

    is_random: whether the forces of a simulated rig depend on the seed; a single run without
        noise is exact
    """
    fair = [item for item in standings if not item.faults and not item.fallbacks]
    if len(fair) < 2:
        return None
    if any(item.thrust_ci95 is None and depends_on_seed(item, is_random) for item in fair):
        return Verdict("none: a single run with noise has no interval; use --runs 5", ())
    candidates = [_candidate(item) for item in fair]
    ranking = rank(candidates)
    names = tuple(item.name for item in ranking.undecided)
    if not ranking.is_decided:
        return Verdict(format_choice(names, names[0], ranking.reason), names)
    best, following = sorted(candidates, key=lambda item: -item.thrust)[:2]
    pairs = len(candidates) * (len(candidates) - 1) // 2
    widths = [half_width(item, pairs) for item in (best, following)]
    share = ratio(best.thrust, widths[0], following.thrust, widths[1])
    if share is None:
        return Verdict(f"{names[0]} wins: no other one has a thrust above zero", names)
    share_text = format_ratio(share) if any(widths) else f"exactly {percent(share[0])}"
    return Verdict(
        f"{names[0]} wins: it thrusts {share_text} of {following.name}, the next one", names
    )


def depends_on_seed(contestant: Contestant | Standing, is_random: bool) -> bool:
    """Return whether another run would differ; a given wave swims the same for any noise."""
    sees = contestant.controller == "ppo" and may_see_pictures(contestant.parameters.get("policy"))
    return sees or (is_random and complexity(contestant.controller) > 0)


def _candidate(standing: Standing) -> Candidate:
    error = standing.thrust_ci95 or 0.0
    by_runs = mean_ci95(standing.thrusts)
    return Candidate(
        standing.contestant,
        standing.thrust,
        error,
        complexity(standing.controller),
        len(standing.thrusts) - 1 if by_runs is not None and error <= by_runs else math.inf,
    )
