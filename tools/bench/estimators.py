"""Thrust of `swing` with each of the two estimators, relative to the best square wave.

The observer uses the true plant, or one that is wrong in every parameter, of the same fish.
"""

import itertools
import os
import random
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from math import radians
from typing import NamedTuple

import msgspec
import numpy as np

from bench.identification import VARIED
from common.report import Options, Report, table
from fishd.assembly import build_loop
from fishd.config import Config
from fishd.controllers import registry
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.core.estimation import EstimatorSettings
from fishd.lab.simulation import Beats, EncodingPublisher
from fishd.virtual.fish import SimulatedFish
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.optimum import best_square_wave
from fishd.virtual.plant.parameters import PlantParameters

DOCUMENT = "how-to/identification.md"

RATIOS = (0.1, 0.25, 0.5, 0.9, 1.5, 3.0)
"""Values of ω₀Φ/Ω."""
CRITERION = 0.6
SECONDS, SETTLE = 140.0, 20.0
"""Length of a run and of its unevaluated start [s]; the rest has two periods of the drift."""
REAL = SimulationSettings(noise=1e-3, offset_y=0.02, drift=5e-3)
WRONG = 0.1
"""Relative error of each parameter of the wrong plant."""


class Rig(NamedTuple):
    """Simulated fish and its sensor."""

    name: str
    plant: PlantParameters
    simulation: SimulationSettings


RIGS = (
    Rig("1 mN noise", PlantParameters(), REAL),
    Rig("5 mN noise", PlantParameters(), msgspec.structs.replace(REAL, noise=5e-3)),
    Rig("20 mN drift", PlantParameters(), msgspec.structs.replace(REAL, drift=0.02)),
    Rig(
        "sensor turned by 5°", PlantParameters(), msgspec.structs.replace(REAL, rotation=radians(5))
    ),
    Rig("delay of 50 ms", PlantParameters(servo_delay=0.05), REAL),
    Rig("delay of 100 ms", PlantParameters(servo_delay=0.1), REAL),
    Rig("drag × 3", PlantParameters(lateral_drag=0.12), REAL),
)
ESTIMATORS = ("model-free", "observer", "observer, wrong plant")


def believed(plant: PlantParameters, estimator: str, seed: int) -> PlantParameters:
    """Return the plant that the observer uses."""
    if estimator != ESTIMATORS[2]:
        return plant
    chance = random.Random(seed)
    values = msgspec.structs.asdict(plant)
    wrong = {name: values[name] * (1 + chance.choice((-WRONG, WRONG))) for name in VARIED}
    return msgspec.structs.replace(plant, **wrong)


def relative_thrust(run: tuple[Rig, str, float, int]) -> float:
    """Return the thrust over that of the best square wave of this amplitude; 0 after a fault."""
    rig, estimator, ratio, seed = run
    amplitude = ratio * PlantParameters().servo_speed / PlantParameters().omega0
    config = Config(
        amplitude_limit=amplitude,
        plant=believed(rig.plant, estimator, seed),
        estimator=EstimatorSettings(
            kind="lateral_force" if estimator == ESTIMATORS[0] else "observer",
            force_noise=rig.simulation.noise,
            sensor_rotation=rig.simulation.rotation,
        ),
    )
    rig_of_seed = msgspec.structs.replace(rig.simulation, seed=seed)
    fish = SimulatedFish(rig.plant, rig_of_seed, config.tick)
    clock = VirtualClock()
    loop = build_loop(config, fish.robot(), clock, EncodingPublisher())
    loop.set_controller("swing", registry.create("swing", {"C": CRITERION}, config.limits))
    beats = Beats()
    slots = virtual_slots(clock, config.tick)
    for tick in range(round(SECONDS / config.tick)):
        angle = loop.applied
        loop.tick(next(slots))
        window = fish.take_window()
        if tick * config.tick >= SETTLE:
            beats.add(angle, window)
    loop.close()
    if loop.supervisor.reason:
        return 0.0
    return beats.means().thrust / best_square_wave(rig.plant, amplitude).thrust


OPTIONS: Options = {
    "--seeds": {"type": int, "default": 5, "help": "runs of each cell; default 5"},
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """Return a table of medians; takes about a minute."""
    runs = list(itertools.product(RIGS, ESTIMATORS, RATIOS, range(options.seeds)))
    with ProcessPoolExecutor(options.jobs) as pool:
        done = list(pool.map(relative_thrust, runs, chunksize=options.seeds))
    shape = (len(RIGS), len(ESTIMATORS), len(RATIOS), options.seeds)
    medians = np.median(np.array(done).reshape(shape), axis=3)
    rows = [
        [rig.name, estimator, *(f"{100 * value:.1f}" for value in medians[i, j])]
        for i, rig in enumerate(RIGS)
        for j, estimator in enumerate(ESTIMATORS)
    ]
    head = " | ".join(["rig", "estimator \\ ω₀Φ/Ω", *(f"{ratio:g}" for ratio in RATIOS)])
    return Report({"bench estimators": table(head, rows)}, medians.tolist())
