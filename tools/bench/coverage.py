"""How often the 95 % interval of a thrust contains the true one, on simulated fish.

    measure      `fishctl measure`, under drifts of the force sensor; some minutes
    calibration  `fishctl measure`, with a sensor that was calibrated with wrong loads; some minutes
    shown        the thrust that is shown during swims of minutes and hours; a quarter of an hour

Each row of a table is a case, swum with several seeds with which nothing was chosen.
"""

import dataclasses
import math
import random
import statistics
from argparse import Namespace
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET
from msgspec.structs import replace

from common.report import JOBS, Options, Report, run_cases, table
from fishd.cli.calibrate.force_dialogue import PLAN
from fishd.config import Config
from fishd.core.calibration import ForceCalibration
from fishd.core.signals import Measurement, Tick
from fishd.hardware.base import ForceSensor
from fishd.hardware.force_sensor.calibration_fit import MIN_LOADS, Load, fit
from fishd.lab.measurement import measure as measure_thrust
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import VirtualRun, simulate
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.base import TrueWindow

RIG = SimulationSettings(noise=1e-3, offset_y=0.01, rotation=0.05)
MEASURE_SEED, CALIBRATION_SEED, SHOWN_SEED = 31_000, 1000, 7000
"""Seeds of the first run of each part."""
LOAD_N, LOAD_S = 0.2, 5.0
"""Force of a load [N], and time for which it is measured [s]."""
REST_S = 3.0
"""Length of each rest of the part `shown` [s]."""
SKIPPED_S = 30.0
"""Length of the start of the part `shown` that does not count [s]."""
SPAN_S = 4.0
"""Time over which the true thrust is averaged, in whole beats [s]."""

Force = Callable[[float, bool], float]
"""Force that is added to F_x [N], by the time since the start [s] and whether the fish swims."""
Disturbance = Callable[[random.Random, float], Force]
"""Function that returns a force with a random shape for a run of a length [s]."""


def warm_up(tau: float) -> Disturbance:
    """Return a drift of 20 mN with a time constant."""
    return lambda chance, seconds: lambda time, swims: 0.02 * -math.expm1(-time / tau)


def sine(period: float) -> Disturbance:
    """Return a sine of 5 mN with a random phase."""

    def disturb(chance: random.Random, seconds: float) -> Force:
        phase = chance.uniform(0.0, math.tau)
        return lambda time, swims: 5e-3 * math.sin(math.tau * time / period + phase)

    return disturb


def steps(size: float, per_minute: float | None = None) -> Disturbance:
    """Return steps in either direction at random times; one step where no rate is given."""

    def disturb(chance: random.Random, seconds: float) -> Force:
        times = random_times(chance, seconds, per_minute or 0.0)
        if per_minute is None:
            times = [chance.uniform(0.0, seconds)]
        sizes = np.cumsum([0.0, *(chance.choice((-size, size)) for _ in times)])
        return lambda time, swims: float(sizes[np.searchsorted(times, time, "right")])

    return disturb


def flicker(chance: random.Random, seconds: float) -> Force:
    """Return noise with a 1/f spectrum from the inverse length of the run to 10 Hz, 5 mN rms."""
    step, count = 0.05, int(seconds / 0.05) + 2
    spectrum = np.fft.rfft(np.random.default_rng(chance.getrandbits(32)).standard_normal(count))
    spectrum[0] = 0.0
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    noise = np.fft.irfft(spectrum, count)
    noise *= 5e-3 / noise.std()
    return lambda time, swims: float(noise[int(time / step)])


def follow_swimming(chance: random.Random, seconds: float) -> Force:
    """Return a first-order response to swimming of 2 mN with a time constant of 10 s."""
    latest = level = 0.0

    def force(time: float, swims: bool) -> float:
        nonlocal latest, level
        level += (swims - level) * -math.expm1((latest - time) / 10.0)
        latest = time
        return 2e-3 * level

    return force


def outliers(chance: random.Random, seconds: float) -> Force:
    """Return ticks that are off by 20 to 100 mN and times of 0.6 s by 3 to 10 mN, six a minute."""
    pulses = []
    for start in random_times(chance, seconds, 6.0):
        length, low, high = chance.choice(((0.05, 20e-3, 100e-3), (0.6, 3e-3, 10e-3)))
        size = chance.choice((-1, 1)) * chance.uniform(low, high)
        pulses.append((start, start + length, size))
    return lambda time, swims: sum(size for start, end, size in pulses if start <= time < end)


def random_times(chance: random.Random, seconds: float, per_minute: float) -> list[float]:
    """Return the times of a Poisson process [s]; empty for a rate of zero."""
    times: list[float] = []
    while per_minute:
        previous = times[-1] if times else 0.0
        times.append(previous + chance.expovariate(per_minute / 60.0))
        if times[-1] > seconds:
            return times[:-1]
    return times


CONFIGURED: dict[str, dict[str, Any]] = {
    "none": {},
    "sine of 5 mN, 60 s": {"drift": 5e-3},
    "sine of 5 mN, 20 s": {"drift": 5e-3, "drift_period": 20.0},
    "random walk of 0.5 mN/√s": {"drift_walk": 5e-4},
    "line of 0.2 mN/s": {"drift_rate": 2e-4},
}
"""Drifts of the simulated sensor, for the part `measure`."""
ADDED: dict[str, Disturbance] = {
    "one step of 5 mN": steps(5e-3),
    "steps of 3 mN, 3 a minute": steps(3e-3, 3.0),
    "follows swimming, 2 mN in 10 s": follow_swimming,
    "outliers, 6 a minute": outliers,
}
"""Further disturbances of F_x, for the part `measure`."""
DRIFTS: dict[str, Disturbance] = {
    "warm-up, 20 mN in 90 s": warm_up(90.0),
    "warm-up, 20 mN in 8 s": warm_up(8.0),
    "1/f, 5 mN rms": flicker,
    "a step of 5 mN": steps(5e-3),
    "steps of 3 mN, each 20 s": steps(3e-3, 3.0),
    "sine of 5 mN, 9 s": sine(9.0),
    "sine of 5 mN, 20 s": sine(20.0),
}
"""Drifts that are not configured, for the part `shown`."""


class DisturbedSession(VirtualSession):
    """Session on a simulated fish with a force added to F_x that is unknown to fishd."""

    def __init__(self, config: Config, force: Force) -> None:
        super().__init__(config)
        self._force = force

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Swim as `Session.swim` does, with the added force."""
        return self._disturbed(super().swim(controller, parameters, seconds), True)

    def rest(self, seconds: float) -> list[Tick]:
        """Rest as `Session.rest` does, with the added force."""
        return self._disturbed(super().rest(seconds), False)

    def _disturbed(self, ticks: list[Tick], swims: bool) -> list[Tick]:
        return [
            replace(tick, fx=tick.fx + self._force(tick.seq * self.tick, swims)) for tick in ticks
        ]


class Measured(NamedTuple):
    """Result of `fishctl measure`; half-widths of 95 % intervals [N]."""

    thrust: float
    """Thrust [N]."""
    statistical: float
    calibration: float
    total: float
    plain: float
    """Mean of F_x while the fish swims [N]."""
    is_named: bool
    """Whether the result names a disturbance of the zero."""
    is_flagged: bool
    """Whether the result says that it may be wrong."""


def measure_session(session: VirtualSession, seconds: float) -> Measured:
    """Measure `swing` with its defaults."""
    with session as rig:
        result = measure_thrust(rig, "swing", {}, seconds)
    assert result.total_ci95 is not None
    assert result.calibration_ci95 is not None
    plain = float(np.mean([tick.fx for tick in result.ticks if tick.mode == "running"]))
    return Measured(
        *(result.thrust, result.thrust_ci95, result.calibration_ci95, result.total_ci95, plain),
        *(bool(result.disturbances), bool(result.remark)),
    )


def measure_drift(case: tuple[str, float, int]) -> Measured:
    """Measure once; case: name of the drift, length [s], seed."""
    name, seconds, seed = case
    config = Config(simulation=replace(RIG, seed=seed, **CONFIGURED.get(name, {})))
    if name not in ADDED:
        return measure_session(VirtualSession(config), seconds)
    force = ADDED[name](random.Random(f"{name} {seed}"), seconds)
    return measure_session(DisturbedSession(config, force), seconds)


class Loads(NamedTuple):
    """Errors of the loads of a calibration, rms."""

    weight: float = 0.0
    """Error of each load, as a fraction."""
    shared: float = 0.0
    """Error that all loads share, as a fraction."""
    thread: float = 0.0
    """Error of the direction of each load [rad]."""
    load_ci95: float = 0.01
    """Value of `--load-error`."""
    count: int = len(PLAN)


LOADS = {
    "nothing": Loads(),
    "each load by 2 %": Loads(weight=0.02),
    "each load by 2 %, five loads": Loads(weight=0.02, count=MIN_LOADS),
    "each load by 2 %, each thread by 2°": Loads(weight=0.02, thread=math.radians(2.0)),
    "all loads by the same 2 %, `--load-error 0.04`": Loads(shared=0.02, load_ci95=0.04),
}
"""Errors are Gaussian: 95 % of those of 2 % rms are within 4 %."""


def calibrate(loads: Loads, seed: int) -> ForceCalibration:
    """Return the result of `fishctl calibrate force` with such loads; the sensor has 1 V/N."""
    chance = np.random.default_rng([CALIBRATION_SEED, seed - CALIBRATION_SEED])
    cos, sin = math.cos(RIG.rotation), math.sin(RIG.rotation)
    noise = RIG.noise * math.sqrt(Config().tick / LOAD_S)
    shared = 1.0 + loads.shared * chance.standard_normal()
    measured = []
    for _, x, y, _ in PLAN[: loads.count]:
        size = LOAD_N * shared * (1.0 + loads.weight * chance.standard_normal())
        turned = loads.thread * chance.standard_normal()
        fx, fy = size * (x - turned * y), size * (y + turned * x)
        vx, vy = noise * chance.standard_normal(2)
        vx += cos * fx - sin * fy + RIG.offset_x
        vy += sin * fx + cos * fy + RIG.offset_y
        measured.append(Load(LOAD_N * x, LOAD_N * y, vx, vy))
    return fit(measured, loads.load_ci95).calibration


def measure_calibrated(case: tuple[str, float, int]) -> Measured:
    """Measure with such a calibration; case: name of its loads, length [s], seed."""
    name, seconds, seed = case
    config = Config(simulation=replace(RIG, seed=seed))
    return measure_session(VirtualSession(config, calibrate(LOADS[name], seed)), seconds)


def report_measurements(
    marker: str,
    function: Callable[[Any], Measured],
    names: Sequence[str],
    lengths: Sequence[float],
    first_seed: int,
    options: Namespace,
) -> Report:
    """Measure each case with each length and seed, and return the table."""
    truth = simulate(Config(), "swing", {}).mean_thrust
    seeds = range(first_seed, first_seed + options.runs)
    cases = [(name, seconds, seed) for seconds in lengths for name in names for seed in seeds]
    results = run_cases(function, cases, options.jobs)
    rows = []
    for start in range(0, len(cases), len(seeds)):
        name, seconds, _ = cases[start]
        runs = results[start : start + len(seeds)]
        thrust, statistical, calibration, total, plain = np.array([run[:5] for run in runs]).T
        off = np.abs(thrust - truth)
        rows.append(
            [
                f"{seconds:g} s",
                name,
                f"{1e3 * np.sqrt(np.mean(off**2)):.2f} mN",
                *(f"± {1e3 * ci95.mean():.2f} mN" for ci95 in (statistical, calibration, total)),
                f"{np.mean(off < statistical):.0%}",
                f"{np.mean(off < total):.0%}",
                f"{sum(run.is_named for run in runs)} / {sum(run.is_flagged for run in runs)}",
                f"{1e3 * np.sqrt(np.mean((plain - truth) ** 2)):.1f} mN",
            ]
        )
    head = (
        "length | kind of error | rms error | mean statistical interval | mean calibration "
        "interval | mean total interval | statistical contains the true thrust | total contains it "
        "| named / careful | rms error of the plain mean"
    )
    about = f"True thrust {1e3 * truth:.2f} mN, {options.runs} runs of each kind, seeds from"
    text = f"{about} {first_seed}.\n\n{table(head, rows)}"
    figures = [[*case, *run] for case, run in zip(cases, results, strict=True)]
    return Report({marker: text}, figures)


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
    """Case of the part `shown`: a table, its row, and how the fish swims."""

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
            if index * tick_s >= SKIPPED_S and swims and truth.mean is not None:
                yield _shown(tick, case.name in HELD), truth.mean


def _shown(tick: Tick, is_held: bool) -> tuple[float, float] | None:
    """Return thrust and half-width of its interval [N], of the controller `thrust` if `is_held`."""
    if is_held:
        quantities = {} if tick.quantities is UNSET else tick.quantities
        if "held_thrust" not in quantities:
            return None
        return quantities["held_thrust"], quantities["held_thrust_ci95"]
    return None if tick.thrust_ci95 is UNSET else (tick.thrust, tick.thrust_ci95)


def report_shown(options: Namespace) -> Report:
    """Swim every case of the part `shown`, and return its tables."""
    seeds = range(SHOWN_SEED, SHOWN_SEED + options.runs)
    hours, hour = seeds[: options.hours], 60.0 * options.minutes
    own = {"offset_y": 0.01, "drift": 0.005, "rotation": 0.05}
    cases = [
        *(Swim("thrust quiet", n, w, 300.0, seed) for n, w in WAVES.items() for seed in seeds),
        *(Swim("thrust drifts", n, WAVES["swing"], 300.0, seed, drift=n)
          for n in DRIFTS for seed in seeds),
        *(Swim("thrust hour", n, w, hour, seed, rig=own)
          for n, w in WAVES.items() for seed in hours),
        *(Swim("thrust hour rests", n, w, hour, seed, hour / 6.0, own)
          for n, w in WAVES.items() for seed in hours),
        *(Swim("thrust held", n, w, 0.5 * hour, seed) for n, w in HELD.items() for seed in hours),
    ]  # fmt: skip
    results = run_cases(swim, cases, options.jobs)
    rows: dict[str, dict[str, list[Shown]]] = {}
    for case, shown in zip(cases, results, strict=True):
        rows.setdefault(case.marker, {}).setdefault(case.name, []).append(shown)
    head = (
        "swim | true thrust, mN | ticks whose interval contains it | the same, worst run | "
        "median half-width, mN | largest half-width, mN | mean error, mN"
    )
    sections = {
        marker: table(head, [_row(name, runs) for name, runs in by_name.items()])
        for marker, by_name in rows.items()
    }
    return Report(sections, rows)


def _row(name: str, runs: list[Shown]) -> list[str]:
    withheld = statistics.fmean(run.withheld for run in runs)
    return [
        name,
        f"{1e3 * statistics.fmean(run.truth for run in runs):.2f}",
        f"{statistics.fmean(run.inside for run in runs):.0%}"
        + (f" ({withheld:.0%} show none)" if withheld > 0.005 else ""),
        f"{min(run.inside for run in runs):.0%}",
        f"{1e3 * statistics.fmean(run.median_ci95 for run in runs):.2f}",
        f"{1e3 * max(run.largest_ci95 for run in runs):.2f}",
        f"{1e3 * statistics.fmean(run.error for run in runs):+.2f}",
    ]


PARTS = {
    "measure": partial(
        report_measurements,
        *("coverage", measure_drift, (*CONFIGURED, *ADDED), (30.0, 60.0), MEASURE_SEED),
    ),
    "calibration": partial(
        report_measurements,
        *("calibration", measure_calibrated, tuple(LOADS), (60.0,), CALIBRATION_SEED),
    ),
    "shown": report_shown,
}
OPTIONS: Options = {
    **JOBS,
    "--runs": {"type": int, "default": 60, "help": "runs of each case; default: 60"},
    "--hours": {"type": int, "default": 4, "help": "runs of an hour of each case; default: 4"},
    "--minutes": {"type": float, "default": 60.0, "help": "length of those runs; default: 60"},
}
