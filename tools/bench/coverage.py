"""How often the 95 % interval of a thrust contains the true one, on simulated fish.

    measure      `fishctl measure`, under drifts of the force sensor; some minutes
    calibration  `fishctl measure`, with a sensor that was calibrated with wrong loads; some minutes
    shown        the thrust that is shown during swims of minutes and hours; a quarter of an hour

Each row of a table is a case, swum with several seeds with which nothing was chosen.
"""

import math
import random
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from bench.disturbances import Disturbance, Force, follow_swimming, outliers, steps
from bench.shown_thrust import report_shown
from common.report import JOBS, Options, Report, run_cases, table
from fishd.cli.calibrate.force_dialogue import PLAN
from fishd.config import Config
from fishd.core.calibration import ForceCalibration
from fishd.core.signals import Tick
from fishd.hardware.force_sensor.calibration_fit import MIN_LOADS, Load, fit
from fishd.lab.measurement import measure as measure_thrust
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings

RIG = SimulationSettings(noise=1e-3, offset_y=0.01, rotation=0.05)
MEASURE_SEED, CALIBRATION_SEED = 31_000, 1000
"""Seeds of the first run of the parts `measure` and `calibration`."""
LOAD_N, LOAD_S = 0.2, 5.0
"""Force of a load [N], and time for which it is measured [s]."""
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


KINDS = {"coverage": "measure, drifts", "calibration": "measure, wrong loads"}
"""Names of the errors of the parts, by the markers of their tables."""


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
    errors = {KINDS[marker]: [(run.thrust - truth) / run.total for run in results]}
    return Report({marker: text}, figures, errors=errors)


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
