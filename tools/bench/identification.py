"""How true `fishctl identify` is: errors and coverage of its intervals, on fish that are known.

Each fish swims one experiment of three minutes in virtual time, measured with noise, a turned
sensor, offsets and drift. Every fit begins with the default fish.
"""

import os
import random
from argparse import Namespace
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from math import radians
from typing import Any

import msgspec
import numpy as np

from common.report import Options, Report, table
from fishd.config import Config
from fishd.lab.identification import experiment, identify
from fishd.lab.rig import VirtualRig
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

DOCUMENT = "identification.md"

RIG = SimulationSettings(noise=1e-3, rotation=radians(5), offset_x=0.02, offset_y=0.02, drift=5e-3)
SPREAD = 0.3
"""Other fish differ from the default one by up to this share, in each of:"""
VARIED = (
    "omega0", "xi", "coupling", "servo_speed", "servo_lag", "thrust_coefficient", "lateral_drag",
)  # fmt: skip
LONGEST_DELAY, MOST_BACKLASH = 0.1, 0.05
"""[s], [rad]"""
SECONDS = 180.0
ABSOLUTE = {"servo_delay": (1e3, "ms"), "backlash": (1e3, "mrad")}
"""Judged by their errors; all others by their share of the truth."""


def fish(kind: str, seed: int) -> PlantParameters:
    """A fish that is known: `default`, `driven` (the same with delay and backlash), or `other`."""
    if kind == "default":
        return PlantParameters()
    if kind == "driven":
        return PlantParameters(servo_delay=0.03, backlash=0.02)
    chance = random.Random(1000 + seed)
    plain = msgspec.structs.asdict(PlantParameters())
    varied = {name: plain[name] * chance.uniform(1 - SPREAD, 1 + SPREAD) for name in VARIED}
    return PlantParameters(
        **varied,
        servo_delay=chance.uniform(0.0, LONGEST_DELAY),
        backlash=chance.uniform(0.0, MOST_BACKLASH),
    )


def one(run: tuple[str, int]) -> dict[str, tuple[float, float, float, float]]:
    """Truth, value, low and high of everything, of one experiment."""
    kind, seed = run
    plant, rig = fish(kind, seed), msgspec.structs.replace(RIG, seed=seed)
    with VirtualRig(Config(plant=plant, simulation=rig)) as swum:
        found = identify(experiment(swum, SECONDS))
    truth: dict[str, Any] = msgspec.structs.asdict(plant) | msgspec.structs.asdict(rig)
    # Nearly three whole periods of the drift: its mean is as good as zero.
    return {
        each.name: (truth[each.name], each.value, each.low, each.high)
        for each in found.estimates
        if each.fitted
    }


def rows(runs: Sequence[dict[str, tuple[float, float, float, float]]]) -> list[list[str]]:
    """One for each quantity: errors, width, coverage."""
    found = []
    for name in runs[0]:
        factor, unit = ABSOLUTE.get(name, (100.0, "%"))
        truth, value, low, high = np.array([run[name] for run in runs]).T
        scale = factor if name in ABSOLUTE else factor / np.abs(truth)
        error, width = np.abs(value - truth) * scale, 0.5 * (high - low) * scale
        covered = int(np.sum((low <= truth) & (truth <= high)))
        found.append(
            [
                f"`{name}`",
                *(f"{x:.2g} {unit}" for x in (np.median(error), error.max(), np.median(width))),
                f"{covered} of {len(runs)}",
            ]
        )
    return found


HEAD = "quantity | error, median | error, largest | half of the 95 % interval | it covers the truth"
OPTIONS: Options = {
    "--seeds": {"type": int, "default": 20, "help": "experiments of each kind; default 20"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """The three tables; each experiment takes some seconds."""
    sections, figures = {}, {}
    with ProcessPoolExecutor(options.jobs) as pool:
        for kind in ("default", "driven", "other"):
            runs = list(pool.map(one, [(kind, seed) for seed in range(options.seeds)]))
            sections[f"bench identification {kind}"] = table(HEAD, rows(runs))
            figures[kind] = runs
    return Report(sections, figures)
