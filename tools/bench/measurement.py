"""Accuracy of `fishctl measure` under several drifts of the force sensor.

Each number is of many runs on the simulated fish, of `swing` with its defaults; the runs differ in
the seed of noise and drift. The truth is that of the plant. Drifts that the simulation does not
have are added to the F_x of the ticks.
"""

import math
import os
import random
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import joblib
import numpy as np
from msgspec.structs import replace

from common.report import Options, Report, progress, table
from fishd.config import Config
from fishd.core.signals import Tick
from fishd.lab.measurement import measure as measured
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings

DOCUMENT = "how-to/measuring.md"
FIRST_SEED = 31_000
"""Seed of the first run; nothing was chosen with it or the following ones."""
DRIFTS: dict[str, dict[str, Any]] = {
    "none": {},
    "sine of 5 mN, 60 s": {"drift": 5e-3},
    "sine of 5 mN, 20 s": {"drift": 5e-3, "drift_period": 20.0},
    "random walk of 0.5 mN/√s": {"drift_walk": 5e-4},
    "line of 0.2 mN/s": {"drift_rate": 2e-4},
}
LENGTHS = (30.0, 60.0)
RIG = SimulationSettings(noise=1e-3, offset_y=0.01, rotation=0.05)

OPTIONS: Options = {
    "--runs": {"type": int, "default": 60, "help": "runs of each kind"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


Force = Callable[[float, bool], float]
"""A force that is added to F_x [N], at a time since the start [s], while the fish swims or not."""


def step_once(chance: random.Random, seconds: float) -> Force:
    """Return a step of 5 mN either way at a random time."""
    size, at = chance.choice((-5e-3, 5e-3)), chance.uniform(0.0, seconds)
    return lambda time, swims: size if time >= at else 0.0


def random_steps(chance: random.Random, seconds: float) -> Force:
    """Return steps of 3 mN either way, three a minute on average, at random times."""
    steps = [(at, chance.choice((-3e-3, 3e-3))) for at in _times(chance, seconds, 3.0)]
    return lambda time, swims: sum(size for at, size in steps if time >= at)


def follows_swimming(chance: random.Random, seconds: float) -> Force:
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
    far = []
    for at in _times(chance, seconds, 6.0):
        lasts, low, high = chance.choice(((0.05, 20e-3, 100e-3), (0.6, 3e-3, 10e-3)))
        far.append((at, at + lasts, chance.choice((-1, 1)) * chance.uniform(low, high)))
    return lambda time, swims: sum(size for begin, end, size in far if begin <= time < end)


def _times(chance: random.Random, seconds: float, per_minute: float) -> Sequence[float]:
    """Return the times of a Poisson process [s]."""
    times = [chance.expovariate(per_minute / 60.0)]
    while times[-1] < seconds:
        times.append(times[-1] + chance.expovariate(per_minute / 60.0))
    return times[:-1]


ADDED: dict[str, Callable[[random.Random, float], Force]] = {
    "one step of 5 mN": step_once,
    "steps of 3 mN, 3 a minute": random_steps,
    "follows swimming, 2 mN in 10 s": follows_swimming,
    "outliers, 6 a minute": outliers,
}


class DisturbedRig(VirtualSession):
    """Simulated fish with a force added to F_x that is unknown to fishd."""

    def __init__(self, config: Config, force: Force) -> None:
        super().__init__(config)
        self._force = force

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Swim like `Rig.swim`, with the added force."""
        return self._disturbed(super().swim(controller, parameters, seconds), True)

    def rest(self, seconds: float) -> list[Tick]:
        """Rest like `Rig.rest`, with the added force."""
        return self._disturbed(super().rest(seconds), False)

    def _disturbed(self, ticks: list[Tick], swims: bool) -> list[Tick]:
        return [
            replace(tick, fx=tick.fx + self._force(tick.seq * self.tick, swims)) for tick in ticks
        ]


class Run(NamedTuple):
    """Result of one measurement; forces in N."""

    thrust: float
    error: float
    """Half-width of the statistical interval."""
    total_ci95: float
    """Half-width of the interval that includes the sensor's rotation."""
    plain: float
    """Plain mean of F_x while the fish swims."""
    is_named: bool
    """Whether the result names a disturbance of the zero."""
    is_flagged: bool
    """Whether the result says that it may be wrong."""


def run(drift: str, seconds: float, seed: int) -> Run:
    """Measure once."""
    config = Config(simulation=replace(RIG, seed=seed, **DRIFTS.get(drift, {})))
    force = ADDED[drift](random.Random(f"{drift} {seed}"), seconds) if drift in ADDED else None
    with DisturbedRig(config, force) if force else VirtualSession(config) as rig:
        measurement = measured(rig, "swing", {}, seconds)
    plain = float(np.mean([tick.fx for tick in measurement.ticks if tick.mode == "running"]))
    assert measurement.total_ci95 is not None
    named, flagged = bool(measurement.disturbances), bool(measurement.remark)
    return Run(measurement.thrust, measurement.error, measurement.total_ci95, plain, named, flagged)


def measure(options: Namespace) -> Report:
    """Measure each kind of drift, for each length."""
    truth = simulate(Config(), "swing", {}).mean_thrust
    rows, figures = [], []
    with joblib.Parallel(options.jobs) as pool:
        for seconds in LENGTHS:
            for drift in (*DRIFTS, *ADDED):
                seeds = range(FIRST_SEED, FIRST_SEED + options.runs)
                runs = pool(joblib.delayed(run)(drift, seconds, seed) for seed in seeds)
                figures.append(figure := _figure(runs, truth, seconds, drift))
                rows.append(
                    (
                        f"{seconds:g} s",
                        drift,
                        f"{1e3 * figure['rms']:.2f} mN",
                        f"± {1e3 * figure['error']:.2f} mN",
                        f"± {1e3 * figure['total_ci95']:.2f} mN",
                        f"{figure['coverage']:.0%}",
                        f"{figure['named']} / {figure['flagged']}",
                        f"{1e3 * figure['plain']:.1f} mN",
                    )
                )
                progress(*rows[-1])
    head = (
        "length | drift | rms error | mean statistical interval | mean total interval "
        "| contains the true thrust | named / careful | rms error of the plain mean"
    )
    text = (
        f"True thrust {1e3 * truth:.2f} mN, {options.runs} runs of each kind, seeds from "
        f"{FIRST_SEED}.\n\n"
    )
    return Report({"coverage": text + table(head, rows)}, figures)


def _figure(runs: Sequence[Run], truth: float, seconds: float, drift: str) -> dict[str, Any]:
    thrust, error, total, plain = np.array([one[:4] for one in runs]).T
    held = np.abs(thrust - truth) < total
    unflagged = np.array([not one.is_flagged for one in runs])
    return {
        "seconds": seconds,
        "drift": drift,
        "runs": len(runs),
        "rms": float(np.sqrt(np.mean((thrust - truth) ** 2))),
        "error": float(error.mean()),
        "total_ci95": float(total.mean()),
        "coverage": float(held.mean()),
        "coverage_by_error_alone": float(np.mean(np.abs(thrust - truth) < error)),
        "named": sum(one.is_named for one in runs),
        "flagged": int((~unflagged).sum()),
        "coverage_unflagged": float(held[unflagged].mean()) if unflagged.any() else None,
        "plain": float(np.sqrt(np.mean((plain - truth) ** 2))),
    }
