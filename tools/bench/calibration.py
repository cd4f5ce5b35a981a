"""Coverage of the interval of `fishctl measure` for a sensor that is calibrated wrongly.

Each run calibrates the sensor of the default fish, turned by 0.05 rad, with loads that are not what
they are said to be, and measures `swing` with its defaults. The truth is the fish's own thrust.
"""

import os
from argparse import Namespace
from typing import NamedTuple

import joblib
import numpy as np
from msgspec.structs import replace

from common.report import Options, Report, table
from fishd.cli.calibrate.force_dialogue import PLAN
from fishd.config import Config
from fishd.core.calibration import ForceCalibration
from fishd.hardware.force_sensor.calibration_fit import MIN_LOADS, Load, fit
from fishd.lab.measurement import measure as measured
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings

DOCUMENT = "how-to/measuring.md"
RIG = SimulationSettings(noise=1e-3, offset_y=0.01, rotation=0.05)
LOAD_N = 0.2
LOAD_SECONDS = 5.0
RUN_SECONDS = 60.0
FIRST_SEED = 1000


class Case(NamedTuple):
    """Errors of the loads, rms, and the `--load-error` that is given for them."""

    weight: float = 0.0
    """Error of each load, as a fraction."""
    shared: float = 0.0
    """Error that all loads share, as a fraction."""
    thread: float = 0.0
    """Direction of each load [rad]."""
    load_error: float = 0.01
    """Value of `--load-error`."""
    loads: int = len(PLAN)


CASES = {
    "none": Case(),
    "each load by 2 %": Case(weight=0.02),
    "each load by 2 %, five loads": Case(weight=0.02, loads=MIN_LOADS),
    "each load by 2 %, each thread by 2°": Case(weight=0.02, thread=np.radians(2.0)),
    "all loads by the same 2 %, `--load-error 0.04`": Case(shared=0.02, load_error=0.04),
}
"""Errors are Gaussian: 95 % of those of 2 % rms are within 4 %."""

OPTIONS: Options = {
    "--runs": {"type": int, "default": 60, "help": "runs of each kind"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def calibrated(case: Case, seed: int) -> ForceCalibration:
    """Return what `fishctl calibrate force` makes of such loads; the sensor has 1 V/N."""
    random = np.random.default_rng([FIRST_SEED, seed])
    cos, sin = np.cos(RIG.rotation), np.sin(RIG.rotation)
    noise = RIG.noise * np.sqrt(Config().tick / LOAD_SECONDS)
    shared = 1.0 + case.shared * random.standard_normal()
    loads = []
    for _, x, y, _ in PLAN[: case.loads]:
        size = LOAD_N * shared * (1.0 + case.weight * random.standard_normal())
        turned = case.thread * random.standard_normal()
        fx, fy = size * (x - turned * y), size * (y + turned * x)
        vx, vy = noise * random.standard_normal(2)
        vx += cos * fx - sin * fy + RIG.offset_x
        vy += sin * fx + cos * fy + RIG.offset_y
        loads.append(Load(LOAD_N * x, LOAD_N * y, vx, vy))
    return fit(loads, case.load_error).calibration


def run(case: Case, seed: int) -> tuple[float, float, float, float]:
    """Return the thrust, and its statistical error, that of the calibration, and of both [N]."""
    config = Config(simulation=replace(RIG, seed=FIRST_SEED + seed))
    with VirtualSession(config, calibrated(case, seed)) as rig:
        measurement = measured(rig, "swing", {}, RUN_SECONDS)
    assert measurement.calibration_ci95 is not None
    assert measurement.total_ci95 is not None
    calibration_ci95, total_ci95 = measurement.calibration_ci95, measurement.total_ci95
    return measurement.thrust, measurement.error, calibration_ci95, total_ci95


def measure(options: Namespace) -> Report:
    """Measure each kind of error."""
    truth = 1e3 * simulate(Config(), "swing", {}).mean_thrust
    rows, figures = [], []
    with joblib.Parallel(options.jobs) as pool:
        for name, case in CASES.items():
            runs = pool(joblib.delayed(run)(case, i) for i in range(options.runs))
            thrust, statistical, calibration, total = 1e3 * np.array(runs).T
            off = np.abs(thrust - truth)
            figure = {
                "loads": name,
                "runs": options.runs,
                "rms": float(np.sqrt(np.mean(off**2))),
                "statistical": float(np.median(statistical)),
                "calibration": float(np.median(calibration)),
                "statistical_holds": float(np.mean(off < statistical)),
                "total_holds": float(np.mean(off < total)),
            }
            figures.append(figure)
            rows.append(
                (
                    name,
                    f"{figure['rms']:.2f} mN",
                    f"± {figure['statistical']:.2f} mN",
                    f"± {figure['calibration']:.2f} mN",
                    f"{figure['statistical_holds']:.0%}",
                    f"{figure['total_holds']:.0%}",
                )
            )
    head = (
        "error of the loads, rms | rms error | median statistical | median calibration | "
        "statistical contains the true thrust | total contains it"
    )
    text = (
        f"True thrust {truth:.2f} mN, {options.runs} runs of {RUN_SECONDS:g} s of each kind, seeds "
        f"from {FIRST_SEED}; nine loads of {LOAD_N:g} N and `--load-error 0.01` unless the row "
        "has another value.\n\n"
    )
    return Report({"calibration": text + table(head, rows)}, figures)
