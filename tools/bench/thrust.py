"""Error and settling time of `thrust`, by its prior knowledge of the fish.

Errors are those of the plant's true mean thrust, from 10 s on.
"""

import math
import os
from argparse import Namespace
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from common.report import Options, Report, table
from fishd.config import Config, load
from fishd.lab.measurement import measure as measured
from fishd.lab.measurement import summarise
from fishd.lab.other_fish import OtherFish, harsh
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import KeepingPublisher, VirtualRun, simulate

DOCUMENT = "explanation/holding-thrust.md"
TARGETS = (2, 4, 6, 8, 10, 12, 14, 20, 26)
"""Targets [mN]."""
SEEDS = range(10)
FIRST_SEED = 300
FISH = 20
SECONDS = 60.0
HELD_AFTER = 10.0
"""Time from which the mean thrust is evaluated [s]."""
REST_S, SWIM_S = 3.0, 15.0
"""Duration of the rest before the start, and with a known factor of the swim that calibrates its
wave [s]."""
BAND, WINDOW = 0.02, 3.0
"""Relative band around the target, and length of the averages that must stay in it [s]."""
RIG = ("simulation.noise=1e-3", "simulation.offset_y=0.02", "simulation.drift=5e-3")
WAYS = {
    "none": "nothing is known",
    "swing": "`fishctl measure swing`",
    "own": "`fishctl measure thrust` at the target",
    "model": "`estimator.kind: observer`, the fish as it is",
}


class Held(NamedTuple):
    """Result of one run."""

    target: float
    """[N]"""
    thrust: float
    """True mean thrust [N]."""
    settled: float
    """[s]"""
    stated: float
    """Half-width of its final interval relative to its thrust; infinite without one."""
    amplitude: float
    """Amplitude at the end [rad]."""
    saturated: float
    spread: float
    """Standard deviation of the true thrust of beats, relative to the mean."""

    @property
    def error(self) -> float:
        """Error relative to the target."""
        return self.thrust / self.target - 1.0


def held(
    overrides: tuple[str, ...],
    target: float,
    factor: tuple[float, float] | None,
    way: str = "thrust",
) -> Held:
    """Run `thrust` from rest.

    factor: thrust over the mean square of the fin velocity, and half-width of its interval
    way: controller to which the factor belongs
    """
    config, keeper = load(None, overrides), KeepingPublisher()
    with VirtualRun(config, keeper) as run:
        rest = round(REST_S / config.tick)
        for _ in range(rest):
            run.tick()
        if factor:
            run.set_controller(way, {"target": target} if way == "thrust" else {})
            for _ in range(round(SWIM_S / config.tick)):
                run.tick()
            run.loop.thrust.calibrate(*factor)
            run.loop.stop()
            for _ in range(rest):
                run.tick()
        run.set_controller("thrust", {"target": target})
        first = len(keeper.ticks)
        truth = [run.tick().thrust for _ in range(round(SECONDS / config.tick))]
    swum = keeper.ticks[first:]
    beats = np.array(list(_beats([each.phi_c for each in swum], truth, config.tick)))
    late = beats[beats[:, 0] > HELD_AFTER, 1]
    shown: Any = swum[-1].quantities
    return Held(
        target,
        float(late.mean()),
        _settling_time(beats, target),
        shown["held_error"] / shown["held_thrust"] if "held_thrust" in shown else math.inf,
        shown["amplitude"],
        shown["saturated"],
        float(late.std() / late.mean()),
    )


def _beats(angles: list[float], truth: list[float], tick: float) -> Iterator[tuple[float, float]]:
    """Return start and true mean thrust of each whole beat, at distances of half a beat."""
    turns = [k for k, (a, b) in enumerate(pairwise(angles), 1) if a * b < 0.0]
    for a, b in zip(turns, turns[2:], strict=False):
        yield a * tick, float(np.mean(truth[a + 1 : b + 1]))


def _settling_time(beats: Any, target: float) -> float:
    """Return the time from which every mean over `WINDOW` is within `BAND`; else the end."""
    starts = beats[:, 0]
    last = 0.0
    for start in starts[starts < SECONDS - WINDOW]:
        within = (starts >= start) & (starts < start + WINDOW)
        if abs(beats[within, 1].mean() / target - 1.0) > BAND:
            last = start
    return float(starts[starts > last][0])


def exact(overrides: tuple[str, ...], target: float) -> tuple[float, float]:
    """Return the true factor at this target."""
    config, keeper = load(None, overrides), KeepingPublisher()
    with VirtualRun(config, keeper) as run:
        run.set_controller("thrust", {"target": target})
        truth = [run.tick().thrust for _ in range(round(SECONDS / config.tick))]
    half = len(truth) // 2
    power = np.mean([each.fin_velocity**2 for each in keeper.ticks[half:]])
    factor = float(np.mean(truth[half:]) / power)
    return factor, 1e-3 * factor


def by_measurement(
    overrides: tuple[str, ...], controller: str, parameters: dict[str, float]
) -> tuple[float, float] | None:
    """Return the factor of a minute of `fishctl measure`, and half-width of its interval."""
    with VirtualSession(load(None, overrides)) as rig:
        summary = summarise(measured(rig, controller, parameters, 60.0), rig.tick)
    if not summary.thrust > 0.0 or not summary.factor > 0.0:
        return None
    return summary.factor, summary.error / summary.thrust * summary.factor


def factor_of(way: str, overrides: tuple[str, ...], target: float) -> tuple[float, float] | None:
    """Return the factor that is known beforehand."""
    with suppress(ValueError):
        if way == "swing":
            return by_measurement(overrides, "swing", {})
        if way == "own":
            return by_measurement(overrides, "thrust", {"target": target})
        if way == "exact":
            return exact(overrides, target)
    return None


def on_model(job: tuple[str, float, int]) -> Held:
    """Run on the default fish."""
    way, target, seed = job
    overrides = (*RIG, f"simulation.seed={seed}")
    wave = "swing" if way == "swing" else "thrust"
    return held(overrides, target, factor_of(way, overrides, target), wave)


def on_harsh(job: tuple[str, OtherFish]) -> Held:
    """Run on a harsh fish, at half of the thrust of `swing`."""
    way, case = job
    config: Config = load(None, case.overrides)
    target = 0.5 * simulate(config, "swing", {}).mean_thrust
    model = ("estimator.kind=observer",) if way == "model" else ()
    overrides = (*case.overrides, *model)
    wave = "swing" if way == "swing" else "thrust"
    return held(overrides, target, factor_of(way, overrides, target), wave)


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """Return two tables; takes some minutes."""
    ways = ("exact", "swing", "none")
    jobs = [(way, 1e-3 * target, seed) for way in ways for target in TARGETS for seed in SEEDS]
    fish = [(way, harsh(FIRST_SEED + k)) for way in WAYS for k in range(FISH)]
    with ProcessPoolExecutor(options.jobs) as pool:
        model = dict(zip(jobs, pool.map(on_model, jobs, chunksize=4), strict=True))
        strange = list(pool.map(on_harsh, fish))
    rows = []
    for target in TARGETS:
        runs = {way: [model[way, 1e-3 * target, seed] for seed in SEEDS] for way in ways}
        known = runs["exact"]
        rows.append(
            [
                f"{target}",
                f"{np.mean([each.amplitude for each in known]):.3f}",
                f"{np.mean([each.saturated for each in known]):.0f}",
                _seconds(known),
                *(_percent(_rms(runs[way])) for way in ways),
                f"± {_percent(float(np.median([each.stated for each in runs['none']])))}",
            ]
        )
    head = (
        "target, mN | amplitude, rad | `saturated` | settled, s | error, factor known | "
        "after `measure swing` | nothing known | it then states"
    )
    sections = {"thrust model": table(head, rows)}
    rows = []
    for way, name in WAYS.items():
        held_runs = [each for (which, _), each in zip(fish, strange, strict=True) if which == way]
        errors = np.array([abs(each.error) for each in held_runs])
        stated = np.array([each.stated for each in held_runs])
        within = np.sum(errors < stated)
        quantiles = (np.quantile(errors, share) for share in (0.5, 0.9))
        rows.append(
            [
                name,
                *map(_percent, quantiles),
                f"± {_percent(float(np.median(stated)))}",
                f"{within} of {FISH}",
            ]
        )
    head = "what is known | error, median | 90 % below | stated, median | holds the truth"
    sections["thrust harsh"] = table(head, rows)
    figures = {
        "model": [[*job, each._asdict()] for job, each in model.items()],
        "harsh": [
            [way, case.name, each._asdict()]
            for (way, case), each in zip(fish, strange, strict=True)
        ],
    }
    return Report(sections, figures)


def _rms(runs: list[Held]) -> float:
    return float(np.sqrt(np.mean([each.error**2 for each in runs])))


def _seconds(runs: list[Held]) -> str:
    times = [each.settled for each in runs]
    if any(each.saturated for each in runs):
        return "–"
    return f"{np.median(times):.1f}, at most {max(times):.1f}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.00995 else f"{100 * share:.2f} %"
