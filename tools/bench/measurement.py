"""How well `fishctl measure` knows the thrust, under several drifts of the force sensor.

Each number is of many runs on the simulated fish, of `swing` with its defaults; the runs differ in
the seed of noise and drift. The truth is that of the plant.
"""

import os
from argparse import Namespace
from typing import Any

import joblib
import numpy as np
from msgspec.structs import replace

from common.report import Options, Report, table
from fishd.config import Config
from fishd.lab.measurement import measure as measured
from fishd.lab.rig import VirtualRig
from fishd.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings

DOCUMENT = "measuring.md"
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
    "--runs": {"type": int, "default": 150, "help": "runs of each kind"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def run(drift: str, seconds: float, seed: int) -> tuple[float, float, float]:
    """Thrust, half-width of its total interval, plain mean of F_x while it swims [N]."""
    config = Config(simulation=replace(RIG, seed=seed, **DRIFTS[drift]))
    with VirtualRig(config) as rig:
        found = measured(rig, "swing", {}, seconds)
    plain = float(np.mean([tick.fx for tick in found.ticks if tick.mode == "running"]))
    assert found.total_ci95 is not None
    return found.thrust, found.total_ci95, plain


def measure(options: Namespace) -> Report:
    """Measure each kind of drift, for each length."""
    truth = simulate(Config(), "swing", {}).mean_thrust
    rows, figures = [], []
    with joblib.Parallel(options.jobs) as pool:
        for seconds in LENGTHS:
            for drift in DRIFTS:
                runs = pool(joblib.delayed(run)(drift, seconds, i) for i in range(options.runs))
                thrust, error, plain = 1e3 * np.array(runs).T
                off = thrust - 1e3 * truth
                found = {
                    "seconds": seconds,
                    "drift": drift,
                    "runs": options.runs,
                    "rms": float(np.sqrt(np.mean(off**2))),
                    "interval": float(np.mean(error)),
                    "coverage": float(np.mean(np.abs(off) < error)),
                    "plain": float(np.sqrt(np.mean((plain - 1e3 * truth) ** 2))),
                }
                figures.append(found)
                rows.append(
                    (
                        f"{seconds:g} s",
                        drift,
                        f"{found['rms']:.2f} mN",
                        f"± {found['interval']:.2f} mN",
                        f"{found['coverage']:.0%}",
                        f"{found['plain']:.1f} mN",
                    )
                )
    head = "length | drift | error, rms | interval, mean | holds the truth | plain mean, rms"
    text = f"True thrust {1e3 * truth:.2f} mN, {options.runs} runs of each kind.\n\n"
    return Report({"coverage": text + table(head, rows)}, figures)
