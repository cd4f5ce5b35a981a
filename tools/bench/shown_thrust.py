"""How often the interval of a shown thrust contains the true one, in swims of minutes and hours."""

import dataclasses
import math
import random
import statistics
from argparse import Namespace
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET
from msgspec.structs import replace

from bench.disturbances import (
    Disturbance,
    Force,
    flicker,
    line,
    outliers,
    sine,
    steps,
    walk,
    warm_up,
)
from common.report import Report, run_cases, table
from fishd.config import Config
from fishd.control.estimators.live_thrust import LiveThrust
from fishd.core.signals import Measurement, Tick
from fishd.hardware.base import ForceSensor
from fishd.lab.measurement import measure
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import VirtualRun
from fishd.virtual.plant.base import TrueWindow

SEED = 7500
"""Seed of the first run."""
QUIET_RUNS = 6
"""Largest number of runs of each wave without a drift."""
REST_S = 3.0
"""Length of each rest [s]."""
SKIPPED_S = 30.0
"""Length of the start that does not count [s]."""
SPAN_S = 4.0
"""Time over which the true thrust is averaged, in whole beats [s]."""
DRIFTS: dict[str, Disturbance] = {
    "warm-up, 20 mN in 90 s": warm_up(90.0),
    "warm-up, 20 mN in 8 s": warm_up(8.0),
    "1/f, 5 mN rms": flicker,
    "a step of 5 mN": steps(5e-3),
    "steps of 3 mN, each 20 s": steps(3e-3, 3.0),
    "sine of 5 mN, 9 s": sine(9.0),
    "sine of 5 mN, 20 s": sine(20.0),
    "walk of 0.5 mN/√s": walk(5e-4),
    "line of 0.2 mN/s": line(2e-4),
    "outliers, 6 a minute": outliers,
}
"""Drifts that are added to F_x."""
SECOND_REST_S = 55.0, 75.0
"""Range of the time at which the second rest begins in the table of two rests [s]."""
MEASURED_S = 60.0
"""Length of the measurement in the table of measured waves [s]."""
Wave = tuple[str, Mapping[str, Any]]
DITHERED = "swing, dithered C"
DITHER_S = 2.0
"""Time between two random values of C in the wave `DITHERED` [s]."""
WAVES: dict[str, Wave] = {
    "swing": ("swing", {}),
    "sine 1.8 Hz": ("sine", {"frequency": 1.8}),
    "square 1.2 Hz": ("square", {"frequency": 1.2}),
    "square 1.8 Hz": ("square", {"frequency": 1.8}),
    "triangle 1.8 Hz": ("triangle", {"frequency": 1.8}),
    "swing, 0.2 rad": ("swing", {"amplitude": 0.2}),
    "thrust, 15 mN": ("thrust", {"target": 0.015}),
    DITHERED: ("swing", {}),
    "policy default-fish": ("ppo", {"policy": "default-fish"}),
}
HELD: dict[str, Wave] = {f"{mN} mN": ("thrust", {"target": 1e-3 * mN}) for mN in (5, 10, 15, 20)}
"""Targets of `thrust`, judged by its quantities `held_thrust` and `held_thrust_ci95`."""


class Shown(NamedTuple):
    """Quality of the shown thrust in one swim."""

    truth: float
    """Mean true thrust [N]."""
    inside: float
    """Fraction of the ticks whose interval contains the true thrust."""
    withheld: float
    """Fraction of the ticks without an interval."""
    median_ci95: float
    """Median half-width of the interval [N]."""
    largest_ci95: float
    """Largest half-width of the interval [N]."""
    error: float
    """Mean of the shown thrust minus the true one [N]."""


class DriftingSensor:
    """Force sensor with an added drift of F_x."""

    def __init__(self, sensor: ForceSensor, drift: Force) -> None:
        self._sensor, self._drift = sensor, drift

    def read(self, now: float) -> Measurement:
        """Read the sensor, and add the drift."""
        measurement = self._sensor.read(now)
        return replace(measurement, fx=measurement.fx + self._drift(now, True))


class BeatTruth:
    """True thrust over the whole beats of the latest `SPAN_S` seconds."""

    def __init__(self) -> None:
        self.mean: float | None = None
        self._beats: deque[tuple[int, float]] = deque()
        self._count, self._sum, self._angle = 0, 0.0, 0.0
        self._is_open = False

    def add(self, window: TrueWindow, angle: float, tick: float) -> None:
        """Add a tick; angle: instruction angle from this tick on [rad]."""
        self._count += 1
        self._sum += window.thrust
        if self._angle < 0.0 < angle:
            if self._is_open:
                self._beats.append((self._count, self._sum))
            while sum(count for count, _ in self._beats) * tick > SPAN_S and len(self._beats) > 1:
                self._beats.popleft()
            if self._beats:
                counts, sums = zip(*self._beats, strict=True)
                self.mean = sum(sums) / sum(counts)
            self._is_open, self._count, self._sum = True, 0, 0.0
        if angle:
            self._angle = angle


class LastTick:
    """Publisher that stores the latest tick."""

    latest: Tick

    def tick(self, tick: Tick) -> None:
        """Store the tick."""
        self.latest = tick

    def event(self, event: object) -> None:
        """Ignore the event."""


class Swim(NamedTuple):
    """Case: a table, its row, and how the fish swims."""

    marker: str
    name: str
    wave: Wave
    seconds: float
    seed: int
    rest_period: float = math.inf
    """Time from the start of a rest to that of the next one [s]."""
    rig: Mapping[str, float] = {}
    """Changes of the simulated sensor."""
    drift: str = ""
    """Name of an added drift."""
    skipped: float = SKIPPED_S
    """Length of the start that does not count [s]."""
    is_measured: bool = False
    """Whether the wave was measured before."""


def swim(case: Swim) -> Shown:
    """Swim with rests, and compare the shown thrust with the true one."""
    rows: list[tuple[float, float, float]] = []
    ticks = 0
    for shown, truth in shown_thrusts(case):
        ticks += 1
        if shown:
            rows.append((*shown, truth))
    thrust, ci95, truths = np.array(rows).T
    off = thrust - truths
    return Shown(
        float(truths.mean()),
        float(np.mean(np.abs(off) <= ci95)),
        1.0 - len(rows) / ticks,
        float(np.median(ci95)),
        float(ci95.max()),
        float(off.mean()),
    )


def shown_thrusts(case: Swim) -> Iterator[tuple[tuple[float, float] | None, float]]:
    """Yield the shown thrust with its half-width, where there is one, and the true thrust [N]."""
    publisher, (name, parameters) = LastTick(), case.wave
    config = Config()
    config = replace(config, simulation=replace(config.simulation, seed=case.seed, **case.rig))
    tick_s, chance = config.tick, random.Random(case.seed)
    with VirtualRun(config, publisher) as run:
        loop = run.loop
        if case.drift:
            drift = DRIFTS[case.drift](chance, case.seconds + REST_S + 1.0)
            sensor: Any = DriftingSensor(loop.robot.sensor, drift)
            loop.robot = dataclasses.replace(loop.robot, sensor=sensor)
        if case.is_measured:
            _calibrate(loop.perception.thrust, config, case.wave)
        truth = BeatTruth()
        for index in range(round(case.seconds / tick_s)):
            phase = math.fmod(index * tick_s, case.rest_period)
            if phase < 0.5 * tick_s or case.rest_period - phase < 0.5 * tick_s:
                loop.stop()
                truth = BeatTruth()
            elif abs(phase - REST_S) < 0.5 * tick_s:
                run.set_controller(name, parameters)
            swims = phase > REST_S + 2.5  # two whole beats of each wave
            if case.name == DITHERED and swims and index % round(DITHER_S / tick_s) == 0:
                controller = loop.active.controller
                loop.active.retune(replace(controller.parameters, C=chance.uniform(0.4, 0.8)))
            window = run.tick()
            tick = publisher.latest
            truth.add(window, tick.phi_c, tick_s)
            if index * tick_s >= case.skipped and swims and truth.mean is not None:
                yield _shown(tick, case.name in HELD), truth.mean


def _calibrate(live: LiveThrust, config: Config, wave: Wave) -> None:
    """Measure the wave on this rig, and set its factor as `fishctl measure` does."""
    with VirtualSession(config) as rig:
        measured = measure(rig, *wave, MEASURED_S)
    live.calibrate(measured.thrust / measured.power, measured.thrust_ci95 / measured.power)


def _shown(tick: Tick, is_held: bool) -> tuple[float, float] | None:
    """Return thrust and half-width of its interval [N], of the controller `thrust` if `is_held`."""
    if is_held:
        quantities = {} if tick.quantities is UNSET else tick.quantities
        if "held_thrust" not in quantities:
            return None
        return quantities["held_thrust"], quantities["held_thrust_ci95"]
    return None if tick.thrust_ci95 is UNSET else (tick.thrust, tick.thrust_ci95)


def report_shown(options: Namespace) -> Report:
    """Swim every case of some minutes, and return the tables."""
    seeds = range(SEED, SEED + options.runs)
    return _report(
        [
            *(Swim("thrust quiet", n, w, 300.0, seed) for n, w in WAVES.items()
              for seed in seeds[:QUIET_RUNS]),
            *(Swim("thrust drifts", n, WAVES["swing"], 300.0, seed, drift=n)
              for n in DRIFTS for seed in seeds),
            *(_swim_with_two_rests(n, seed) for n in ("none", *DRIFTS) for seed in seeds),
        ],
        options,
    )  # fmt: skip


def report_hours(options: Namespace) -> Report:
    """Swim every case of up to an hour, and return the tables."""
    seeds, hour = range(SEED, SEED + options.hours), 60.0 * options.minutes
    own = {"offset_y": 0.01, "drift": 0.005, "rotation": 0.05}
    return _report(
        [
            *(Swim("thrust hour measured", n, WAVES[n], hour, seed, rig=own, is_measured=True)
              for n in ("swing", "square 1.8 Hz") for seed in seeds),
            *(Swim("thrust hour", n, w, hour, seed, rig=own)
              for n, w in WAVES.items() for seed in seeds),
            *(Swim("thrust hour rests", n, w, hour, seed, hour / 6.0, own)
              for n, w in WAVES.items() for seed in seeds),
            *(Swim("thrust held", n, w, 0.5 * hour, seed) for n, w in HELD.items()
              for seed in seeds),
        ],
        options,
    )  # fmt: skip


def _report(cases: list[Swim], options: Namespace) -> Report:
    """Swim some cases, and return a table of each marker."""
    results = run_cases(swim, cases, options.jobs)
    rows: dict[str, dict[str, list[Shown]]] = {}
    for case, shown in zip(cases, results, strict=True):
        rows.setdefault(case.marker, {}).setdefault(case.name, []).append(shown)
    head = (
        "swim | true thrust, mN | ticks whose interval contains it | the same, worst run | "
        "runs below 90 % | "
        "median half-width, mN | largest half-width, mN | mean error, mN"
    )
    sections = {
        marker: table(head, [_row(name, runs) for name, runs in by_name.items()])
        for marker, by_name in rows.items()
    }
    return Report(sections, rows)


def _swim_with_two_rests(drift: str, seed: int) -> Swim:
    """Return a swim of 50 s after a second rest at a random time."""
    begin = round(random.Random(f"second rest {seed}").uniform(*SECOND_REST_S))
    seconds = begin + REST_S + 50.0
    name = "" if drift == "none" else drift
    return Swim(
        *("thrust two rests", drift, WAVES["swing"], seconds, seed, begin),
        drift=name,
        skipped=begin + REST_S,
    )


def _row(name: str, runs: list[Shown]) -> list[str]:
    withheld = statistics.fmean(run.withheld for run in runs)
    return [
        name,
        f"{1e3 * statistics.fmean(run.truth for run in runs):.2f}",
        f"{statistics.fmean(run.inside for run in runs):.0%}"
        + (f" ({withheld:.0%} show none)" if withheld > 0.005 else ""),
        f"{min(run.inside for run in runs):.0%}",
        f"{sum(run.inside < 0.9 for run in runs)} of {len(runs)}",
        f"{1e3 * statistics.fmean(run.median_ci95 for run in runs):.2f}",
        f"{1e3 * max(run.largest_ci95 for run in runs):.2f}",
        f"{1e3 * statistics.fmean(run.error for run in runs):+.2f}",
    ]
