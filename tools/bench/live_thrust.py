"""Coverage of the interval of the shown thrust, over minutes and an hour.

The shown thrust is `thrust` and `thrust_error` of each tick; the true one is the plant's own, over
the whole beats of the latest 4 s. The first 30 s after the start do not count. Each run begins with
a rest of 3 s.
"""

import dataclasses
import math
import os
import random
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import joblib
import numpy as np
from msgspec import UNSET
from msgspec.structs import replace

from common.report import Options, Report, table
from fishd.config import Config, load
from fishd.core.signals import Measurement, Tick
from fishd.hardware.base import ForceSensor
from fishd.lab.simulation import VirtualRun
from fishd.virtual.plant.base import TrueWindow

DOCUMENT = "how-to/measuring.md"
REST_S = 3.0
"""Length of each rest [s]."""
SKIPPED_S = 30.0
"""Length of the start that does not count [s]."""
SPAN_S = 4.0
"""Length that the true thrust is averaged over, in whole beats [s]."""
DITHER_S = 2.0
"""Time between two random values of C in the wave `dithered C` [s]."""
MINUTES_PER_REST = 10.0
FIRST_SEED = 7000
"""The estimator was made with seeds below 1000."""

Wave = tuple[str, Mapping[str, Any]]
WAVES: dict[str, Wave] = {
    "swing": ("swing", {}),
    "sine 1.8 Hz": ("sine", {"frequency": 1.8}),
    "square 1.2 Hz": ("square", {"frequency": 1.2}),
    "square 1.8 Hz": ("square", {"frequency": 1.8}),
    "triangle 1.8 Hz": ("triangle", {"frequency": 1.8}),
    "swing, 0.2 rad": ("swing", {"amplitude": 0.2}),
    "thrust, 15 mN": ("thrust", {"target": 0.015}),
    "swing, dithered C": ("swing", {}),
    "policy default-fish": ("ppo", {"policy": "default-fish"}),
}
DITHERED = "swing, dithered C"


class Drift(NamedTuple):
    """A function of time that is added to F_x, with a new shape for each seed."""

    name: str
    make: Callable[[random.Random, float], Callable[[float], float]]
    """Takes the random numbers and the length of the run [s]; gives F_x [N] by time [s]."""


def _warm_up(tau: float) -> Callable[[random.Random, float], Callable[[float], float]]:
    return lambda rng, seconds: lambda time: 0.02 * -math.expm1(-time / tau)


def _flicker(rng: random.Random, seconds: float) -> Callable[[float], float]:
    """Return noise with a 1/f spectrum from the inverse length of the run to 10 Hz, 5 mN rms."""
    step, count = 0.05, int(seconds / 0.05) + 2
    white = np.random.default_rng(rng.getrandbits(32)).standard_normal(count)
    spectrum = np.fft.rfft(white)
    spectrum[0] = 0.0
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    noise = np.fft.irfft(spectrum, count)
    noise *= 5e-3 / noise.std()
    return lambda time: float(noise[int(time / step)])


def _step(rng: random.Random, seconds: float) -> Callable[[float], float]:
    begin, size = rng.uniform(0.0, seconds), rng.choice((-5e-3, 5e-3))
    return lambda time: size * (time >= begin)


def _steps(rng: random.Random, seconds: float) -> Callable[[float], float]:
    """Return steps of 3 mN in either direction, on average one in 20 s."""
    begins = sorted(rng.uniform(0.0, seconds) for _ in range(round(seconds / 20.0)))
    sizes = np.cumsum([0.0] + [rng.choice((-3e-3, 3e-3)) for _ in begins])
    return lambda time: float(sizes[np.searchsorted(begins, time)])


def _sine(period: float) -> Callable[[random.Random, float], Callable[[float], float]]:
    def make(rng: random.Random, seconds: float) -> Callable[[float], float]:
        phase = rng.uniform(0.0, math.tau)
        return lambda time: 5e-3 * math.sin(math.tau * time / period + phase)

    return make


DRIFTS = (
    Drift("warm-up, 20 mN in 90 s", _warm_up(90.0)),
    Drift("warm-up, 20 mN in 8 s", _warm_up(8.0)),
    Drift("1/f, 5 mN rms", _flicker),
    Drift("a step of 5 mN", _step),
    Drift("steps of 3 mN, each 20 s", _steps),
    Drift("sine of 5 mN, 9 s", _sine(9.0)),
    Drift("sine of 5 mN, 20 s", _sine(20.0)),
)


class Outcome(NamedTuple):
    """Quality of the shown thrust in one run."""

    truth: float
    """Mean true thrust [N]."""
    inside: float
    """Fraction of the ticks whose interval contains the true value."""
    withheld: float
    """Fraction of the ticks without an interval."""
    median_half_width: float
    """Median half-width of the interval [N]."""
    half_width: float
    """Largest half-width of the interval [N]."""
    error: float
    """Mean of the shown thrust minus the true one [N]."""
    drift: float
    """Change of that error in an hour relative to the thrust, from a linear fit."""
    held_miss: float = math.nan
    """Relative error of the controller `thrust`: mean true thrust over its target, minus 1."""
    held_ci95: float = math.nan
    """Mean half-width of the interval of `held_thrust`, over the target."""
    held_inside: float = math.nan
    """Fraction of the ticks in which the interval of `held_thrust` contains the true value."""


class Drifting:
    """Force sensor with an added drift of F_x."""

    def __init__(self, sensor: ForceSensor, drift: Callable[[float], float]) -> None:
        self._sensor, self._drift = sensor, drift

    def read(self, now: float) -> Measurement:
        """Read the sensor, and add the drift."""
        measurement = self._sensor.read(now)
        return replace(measurement, fx=measurement.fx + self._drift(now))


class BeatTruth:
    """True thrust over the whole beats of the latest seconds."""

    def __init__(self) -> None:
        self.mean: float | None = None
        self._beats: deque[tuple[int, float]] = deque()
        self._count, self._sum, self._angle = 0, 0.0, 0.0
        self._open = False

    def add(self, window: TrueWindow, angle: float, tick: float) -> None:
        """Add a tick; angle: instruction angle from this tick on [rad]."""
        self._count += 1
        self._sum += window.thrust
        if self._angle < 0.0 < angle:
            if self._open:
                self._beats.append((self._count, self._sum))
            while sum(count for count, _ in self._beats) * tick > SPAN_S and len(self._beats) > 1:
                self._beats.popleft()
            if self._beats:
                self.mean = sum(each for _, each in self._beats) / sum(n for n, _ in self._beats)
            self._open, self._count, self._sum = True, 0, 0.0
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


def swim(
    config: Config, wave: str, seconds: float, rest_each: float, drift: Drift | None = None
) -> Outcome:
    """Swim with rests, and compare the shown thrust with the true one.

    rest_each: time from the begin of a rest to that of the next one [s]
    """
    rng = random.Random(config.simulation.seed)
    publisher, (name, parameters) = LastTick(), WAVES[wave]
    rows: list[tuple[float, float, float, float]] = []
    held: list[tuple[float, float]] = []
    withheld = ticks = 0
    with VirtualRun(config, publisher) as run:
        loop = run.loop
        if drift:
            added = drift.make(rng, seconds + REST_S + 1.0)
            loop.robot = replace_sensor(loop.robot, added)
        truth = BeatTruth()
        for index in range(round(seconds / config.tick)):
            time = index * config.tick
            phase = math.fmod(time, rest_each)
            if phase < 0.5 * config.tick or rest_each - phase < 0.5 * config.tick:
                loop.stop()
                truth = BeatTruth()
            elif abs(phase - REST_S) < 0.5 * config.tick:
                run.set_controller(name, parameters)
            swims = phase > REST_S + 2.5  # two whole beats of each wave
            if wave == DITHERED and swims and index % round(DITHER_S / config.tick) == 0:
                controller = loop.active.controller
                loop.active.retune(replace(controller.parameters, C=rng.uniform(0.4, 0.8)))
            window = run.tick()
            tick = publisher.latest
            truth.add(window, tick.phi_c, config.tick)
            if time < SKIPPED_S or not swims or truth.mean is None:
                continue
            ticks += 1
            if tick.thrust_error is UNSET:
                withheld += 1
            else:
                rows.append((time, tick.thrust, tick.thrust_error, truth.mean))
            quantities = tick.quantities
            if name == "thrust" and quantities is not UNSET and "held_thrust" in quantities:
                miss = truth.mean - quantities["held_thrust"]
                held.append((miss, quantities["held_error"]))
    return _judge(np.array(rows).reshape(-1, 4), withheld, ticks, held, parameters.get("target"))


def replace_sensor(robot: Any, added: Callable[[float], float]) -> Any:
    """Return the robot with an added drift of F_x."""
    return dataclasses.replace(robot, sensor=Drifting(robot.sensor, added))


def _judge(
    rows: Any, withheld: int, ticks: int, held: list[tuple[float, float]], target: float | None
) -> Outcome:
    time, thrust, error, truth = rows.T
    off = thrust - truth
    slope = float(np.polyfit(time, off, 1)[0]) if len(rows) > 2 else 0.0
    mean = float(truth.mean())
    outcome = Outcome(
        mean,
        float(np.mean(np.abs(off) <= error)),
        withheld / ticks,
        float(np.median(error)),
        float(error.max()),
        float(off.mean()),
        slope * 3600.0 / mean,
    )
    if not held or target is None:
        return outcome
    miss, ci95 = np.array(held).T
    return outcome._replace(
        held_miss=mean / target - 1.0,
        held_ci95=float(ci95.mean()) / target,
        held_inside=float(np.mean(np.abs(miss) <= ci95)),
    )


def quiet(wave: str, seed: int) -> Outcome:
    """Measure five minutes of the default configuration, whose sensor does not drift."""
    return swim(load(None, [f"simulation.seed={seed}"]), wave, 300.0, math.inf)


def drifting(wave: str, seed: int, rest_each: float) -> Outcome:
    """Measure an hour of the rig of `make run`, with its drift, offset and rotation."""
    config = Config(
        simulation=replace(
            Config().simulation, seed=seed, offset_y=0.01, drift=0.005, rotation=0.05
        )
    )
    return swim(config, wave, 3600.0, rest_each)


def strange(drift: int, seed: int) -> Outcome:
    """Measure five minutes of swing on a sensor with a drift that is not configured."""
    return swim(load(None, [f"simulation.seed={seed}"]), "swing", 300.0, math.inf, DRIFTS[drift])


def holding(target: float, seed: int) -> Outcome:
    """Measure half an hour of `thrust`."""
    WAVES["held"] = ("thrust", {"target": target})
    return swim(load(None, [f"simulation.seed={seed}"]), "held", 1800.0, math.inf)


OPTIONS: Options = {
    "--runs": {"type": int, "default": 20, "help": "runs of five minutes of each kind"},
    "--hours": {"type": int, "default": 4, "help": "runs of an hour of each kind"},
    "--seed": {"type": int, "default": FIRST_SEED, "help": "seed of the first run"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}
HEAD = (
    "{} | true thrust, mN | ticks whose interval contains it | the same, worst run | "
    "median half-width, mN | largest half-width, mN | mean error, mN | drift of the error per hour"
)


def measure(options: Namespace) -> Report:
    """Return four tables; takes a quarter of an hour on two cores."""
    seeds = range(options.seed, options.seed + options.runs)
    hours = seeds[: options.hours]
    with joblib.Parallel(options.jobs) as pool:

        def every(function: Any, ways: Iterable[Any], which: range, *more: Any) -> Any:
            jobs = [(way, seed) for way in ways for seed in which]
            done = pool(joblib.delayed(function)(*job, *more) for job in jobs)
            return {
                way: [each for job, each in zip(jobs, done, strict=True) if job[0] == way]
                for way in ways
            }

        results = {"5 min, no drift": every(quiet, WAVES, seeds)}
        strangers = every(strange, range(len(DRIFTS)), seeds)
        results["5 min of swing"] = {DRIFTS[k].name: runs for k, runs in strangers.items()}
        for name, each in (("1 h, one rest", math.inf), ("1 h, rests", 60.0 * MINUTES_PER_REST)):
            results[name] = every(drifting, WAVES, hours, each)
        held = every(holding, (0.005, 0.01, 0.015, 0.02), hours)
    names = ("thrust quiet", "thrust drifts", "thrust hour", "thrust hour rests")
    sections = {
        marker: table(HEAD.format(kind), [_row(name, runs) for name, runs in ways.items()])
        for marker, (kind, ways) in zip(names, results.items(), strict=True)
    }
    head = (
        "target, mN | true thrust ÷ target − 1 | `held_thrust`: half-width | ticks whose interval "
        "contains the true thrust | the same for the shown thrust"
    )
    rows = [
        (
            f"{1e3 * target:g}",
            ", ".join(f"{100 * run.held_miss:+.1f} %" for run in runs),
            f"{100 * np.mean([run.held_ci95 for run in runs]):.1f} %",
            f"{100 * np.mean([run.held_inside for run in runs]):.0f} %",
            f"{100 * np.mean([run.inside for run in runs]):.0f} %",
        )
        for target, runs in held.items()
    ]
    sections["thrust held"] = table(head, rows)
    figures = {
        kind: {name: [run._asdict() for run in runs] for name, runs in ways.items()}
        for kind, ways in (*results.items(), ("held", {str(k): v for k, v in held.items()}))
    }
    return Report(sections, figures)


def _row(name: str, runs: list[Outcome]) -> tuple[str, ...]:
    def mean(values: Iterable[float]) -> float:
        return float(np.mean(list(values)))

    withheld = mean(run.withheld for run in runs)
    return (
        name,
        f"{1e3 * mean(run.truth for run in runs):.2f}",
        f"{100 * mean(run.inside for run in runs):.0f} %"
        + (f" ({100 * withheld:.0f} % show none)" if withheld else ""),
        f"{100 * min(run.inside for run in runs):.0f} %",
        f"{1e3 * mean(run.median_half_width for run in runs):.2f}",
        f"{1e3 * max(run.half_width for run in runs):.2f}",
        f"{1e3 * mean(run.error for run in runs):+.2f}",
        f"{100 * mean(run.drift for run in runs):+.2f} %",
    )
