"""Results of learning from pictures: steps of the training for each eye, optimum, and speed.

Trainings are those of `fishctl learn ppo --see camera`, in a temporary folder, with seeds that no
setting was chosen with. Relative thrust is the thrust over that of the best square wave.

    steps     control steps until 97 %, babble included; draws docs/figures/camera-learning.png
    optimum   what was learned at four amplitudes, from pictures and from forces
    speed     the environment with pictures, on one core
"""

import math
import statistics
import time
from argparse import Namespace

import joblib
import numpy as np
from msgspec.structs import replace

from bench.learning_curves import learning_curves
from bench.trainings import Row, Trained, rig, settings_of, several
from common.report import DOCS, Options, Report, progress, table
from fishd.camera.simulated import DEFAULT, WEB, SimulatedCameraSettings
from fishd.config import Config
from fishd.lab.compare.contestants import best_on_grid
from fishd.lab.links.simulated_link import Camera, SimulatedLink
from fishd.learning.env.environment import SwimEnv
from fishd.learning.eyes import make_eye
from fishd.learning.settings import TrainingSettings
from fishd.virtual.plant.optimum import best_square_wave

DOCUMENT = "how-to/camera.md"
FIGURE = DOCS / "figures" / "camera-learning.png"
GOOD_RELATIVE_THRUST = 0.97
UNUSED = 230
"""First seed; no setting was chosen with this seed or the following ones."""
TRAINING_STEPS = 4096
"""Number of control steps of a training."""
AMPLITUDES = (0.2, 0.31, 0.42, 0.8)
"""Amplitudes Φ [rad]."""

MODES = replace(settings_of(None, TRAINING_STEPS), see="camera")
CNN = settings_of("learning-cnn.yaml", TRAINING_STEPS)
PAPER = settings_of("learning-camera-paper.yaml", 15_360)
FORCE = settings_of(None, TRAINING_STEPS)


def steps(options: Namespace) -> str:
    """Return the control steps until 97 % for each eye, and draw the curves."""
    blind = replace(CNN, ppo=replace(CNN.ppo, symmetric=False))
    rows = {
        "`modes`, rig default": Row(rig(), MODES),
        "`modes`, rig web": Row(rig(), MODES, WEB),
        "`cnn`, rig default": Row(rig(), CNN),
        "`cnn`, rig web": Row(rig(), CNN, WEB),
        "`cnn`, default, without symmetry": Row(rig(), blind),
        "force": Row(rig(), FORCE),
    }
    trainings = several(rows, range(UNUSED, UNUSED + options.seeds), options.jobs)
    few = range(UNUSED, UNUSED + max(1, round(0.3 * options.seeds)))
    paper = {"as in the paper": Row(rig(), PAPER)}
    trainings |= several(paper, few, options.jobs)
    if options.write:
        shown = ("`modes`, rig default", "`cnn`, rig default", "as in the paper", "force")
        learning_curves(
            FIGURE,
            {name.replace("`", ""): curves(trainings[name]) for name in shown},
            GOOD_RELATIVE_THRUST,
        )
    lines = [[name, *summary(runs)] for name, runs in trainings.items()]
    heads = (
        "input | median steps to 97 % | lowest – highest | seeds that reach it | "
        "best at the end (%) | processor (s for 1000 steps)"
    )
    return table(heads, lines)


def curves(runs: list[Trained]) -> list[tuple[list[int], list[float]]]:
    """Return steps and best relative thrust up to each, for each seed."""
    return [([point.steps for point in one.points], one.best) for one in runs]


def summary(runs: list[Trained]) -> list[str]:
    """Return the cells of a row."""
    reached = sorted(one.steps_to(GOOD_RELATIVE_THRUST) for one in runs)
    ends = sorted(100.0 * one.best[-1] for one in runs)
    return [
        number(statistics.median_low(reached)),
        f"{number(reached[0])} – {number(reached[-1])}",
        f"{sum(math.isfinite(one) for one in reached)} of {len(reached)}",
        f"{statistics.median(ends):.1f} [{ends[0]:.1f} – {ends[-1]:.1f}]",
        f"{statistics.median(one.cost for one in runs):.1f}",
    ]


def number(steps: float) -> str:
    """Format a number of steps, or that it was not reached."""
    return f"{steps:.0f}" if math.isfinite(steps) else "never"


def optimum(options: Namespace) -> str:
    """Return frequency and thrust of the best policies, from forces and from pictures."""
    longer = 8064
    kinds = {
        "force": replace(FORCE, steps=longer),
        "`modes`": replace(MODES, steps=longer),
        "`cnn`": CNN,
    }
    rows = {
        f"{amplitude} {name}": Row(rig(amplitude), settings)
        for amplitude in AMPLITUDES
        for name, settings in kinds.items()
    }
    seeds = range(UNUSED, UNUSED + max(1, round(0.3 * options.seeds)))
    trainings = several(rows, seeds, options.jobs)
    lines = []
    for amplitude in AMPLITUDES:
        config = rig(amplitude)
        grid, best = best_on_grid(config), best_square_wave(config.plant, amplitude)
        cells = [f"{amplitude}", f"{grid.frequency:.2f} / {100.0 * grid.thrust / best.thrust:.1f}"]
        for name in kinds:
            ends = [one.exported for one in trainings[f"{amplitude} {name}"]]
            frequency = statistics.median(end.frequency for end in ends)
            share = statistics.median(100.0 * end.relative_thrust for end in ends)
            low, high = (pick(end.frequency for end in ends) for pick in (min, max))
            cells.append(f"{frequency:.2f} [{low:.2f} – {high:.2f}] / {share:.1f}")
        lines.append(cells)
    heads = " | ".join(("Φ (rad)", "best whole-tick wave", *kinds))
    return (
        f"Frequency (Hz), median [lowest – highest] of {len(seeds)} seeds, and relative thrust "
        f"(%), of the best policy of {longer} steps, `cnn` {TRAINING_STEPS}:\n\n"
        f"{table(heads, lines)}"
    )


def speed(options: Namespace) -> str:
    """Return the steps per second of the environment with pictures, on one core."""
    config = rig()
    lines = []
    for name, camera in (("default", DEFAULT), ("web", WEB)):
        for settings in (MODES, CNN):
            lines.append([settings.camera.eye, name, f"{rate(settings, camera, config):.0f}"])
    return table("eye | rig | steps/s, best of five", lines)


def rate(settings: TrainingSettings, camera: SimulatedCameraSettings, config: Config) -> float:
    """Return the steps per second."""
    eye = make_eye(settings)
    assert eye
    link = SimulatedLink(config, camera=Camera(camera, settings.camera.stack))
    env = SwimEnv(link, config, settings.seen, eye)
    env.reset(seed=0)
    env.babble(0, settings.camera.babble)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (3000, 1)).astype(np.float32)
    rates = []
    for _ in range(5):
        begun = time.process_time()
        for action in actions:
            if env.step(action)[3]:
                env.reset()
        rates.append(len(actions) / (time.process_time() - begun))
    return max(rates)


PARTS = {"steps": steps, "optimum": optimum, "speed": speed}
OPTIONS: Options = {
    "part": {"choices": (*PARTS, "all")},
    "--seeds": {"type": int, "default": 10, "help": "trainings of each row; default 10"},
    "--jobs": {"type": int, "default": joblib.cpu_count(), "help": "processes"},
}


def measure(options: Namespace) -> Report:
    """Return the requested parts."""
    sections = {}
    for part in PARTS if options.part == "all" else (options.part,):
        begun = time.perf_counter()
        sections[f"bench pictures {part}"] = PARTS[part](options)
        progress(part, f"{time.perf_counter() - begun:.0f} s")
    return Report(sections, sections)
