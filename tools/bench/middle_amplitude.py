"""Learning at Φ = 0.3 rad, for `learning`, where a seed may stay at half beats of five ticks."""

import math
import statistics
import tempfile
from argparse import Namespace
from pathlib import Path
from typing import NamedTuple

import torch
from msgspec.structs import replace

from bench.trainings import Row, rig, settings_of, several, to_reach
from common.report import progress, spread, table
from fishd.config import Config
from fishd.lab.links.simulated_link import SimulatedLink
from fishd.learning.env.environment import SwimEnv, best_thrust
from fishd.learning.run_folder.checkpoints import list_all, load_policy
from fishd.learning.run_folder.tables import best_so_far, read_evaluations
from fishd.learning.train.jobs import Job
from fishd.learning.train.training import train
from fishd.virtual.plant.optimum import square_wave

AMPLITUDE_RAD = 0.3
SEEDS = range(250, 261)
"""Seeds that no setting was chosen with."""
WATCHED_SEED = 252
"""Seed whose policy swims half beats of five ticks at the end of its training."""
STEPS, LONG_STEPS = 2048, 8000
"""Control steps of each training, and of that of the watched seed."""
NEARLY, GOOD_RELATIVE_THRUST = 0.95, 0.97
WATCHED_TICKS = 400
"""Number of ticks in which the commands of a policy are evaluated."""


class Checkpoint(NamedTuple):
    """Behaviour of a policy after some steps of its training."""

    steps: int
    half_beat: float
    """Median half beat without exploration [ticks]."""
    stay: float
    """Median probability that exploration delays a reversal by one tick."""


def amplitude(options: Namespace) -> str:
    """Return the table of the trainings."""
    config, seeds = rig(AMPLITUDE_RAD), SEEDS[: options.seeds]
    name = f"Φ = {AMPLITUDE_RAD} rad"
    runs = several({name: Row(config, settings_of(None, STEPS))}, seeds, options.jobs)[name]
    cells = [name, *to_reach(runs, NEARLY), *to_reach(runs, GOOD_RELATIVE_THRUST)]
    cells.append(spread([run.best[-1] for run in runs]))
    cells.append(spread([run.exported.frequency for run in runs], 1.0, 3))
    heads = (
        f" | {100 * NEARLY:.0f} % | seeds | {100 * GOOD_RELATIVE_THRUST:.0f} % | seeds | "
        "best policy (%) | "
        "its frequency (Hz)"
    )
    waves = (wave(config, ticks) for ticks in (4, 5, 6, 7))
    parts = [
        f"Steps until the best policy so far has that relative thrust, and the best policy after "
        f"{STEPS} steps, median [lowest – highest] of seeds {seeds[0]} to {seeds[-1]}:",
        table(heads, [cells]),
        f"Square waves by the ticks of half a beat: {', '.join(waves)}.",
    ]
    return "\n\n".join(parts)


def wave(config: Config, ticks: int) -> str:
    """Return the relative thrust of a square wave with half beats of `ticks` ticks."""
    frequency = 0.5 / (ticks * config.tick)
    thrust = square_wave(config.plant, config.amplitude_limit, frequency).thrust
    return f"{ticks} ticks ({frequency:.2f} Hz) {100 * thrust / best_thrust(config):.1f} %"


def exploration(options: Namespace) -> str:
    """Train the watched seed for longer, and return a table of its policies' exploration."""
    config, seed = rig(AMPLITUDE_RAD), WATCHED_SEED
    fish = replace(config, simulation=replace(config.simulation, seed=seed))
    settings = replace(settings_of(None, LONG_STEPS), seed=seed, checkpoint_every=500)
    with tempfile.TemporaryDirectory() as temporary:
        job = Job(config=fish, settings=settings, folder=Path(temporary) / "run")
        train(job)
        points = read_evaluations(job.folder)
        shares = {point.steps: point.relative_thrust for point in points}
        best = best_so_far(points)[-1]
        folders = [each for each in list_all(job.folder) if each.name.startswith("step-")]
        checkpoints = [checkpoint(fish, each) for each in folders[1:]]
    rows = []
    for each in (checkpoints[0], *checkpoints[1:4:2], *checkpoints[7::8]):
        share = f"{100.0 * shares[each.steps]:.1f}" if each.steps in shares else "–"
        cells = (each.steps, share, f"{each.half_beat:g}", f"{each.stay:.0e}")
        rows.append([str(cell) for cell in cells])
        progress(f"seed {seed}", *rows[-1])
    heads = "steps | relative thrust (%) | half beat (ticks) | probability of a delayed reversal"
    return f"Seed {seed}, best policy after {LONG_STEPS} steps {100 * best:.1f} %:\n\n" + table(
        heads, rows
    )


def checkpoint(config: Config, folder: Path) -> Checkpoint:
    """Run the policy of a checkpoint without exploration, and return its reversals."""
    policy, _ = load_policy(folder)
    env = SwimEnv(SimulatedLink(config), config, settings_of(None).environment)
    seen, _ = env.reset(seed=0)
    halves, stays = [], []
    for _ in range(WATCHED_TICKS):
        side = math.copysign(1.0, env.latest.instruction_angle)
        elapsed = round(abs(env.latest.side_time) / config.tick)
        with torch.no_grad():
            mean = float(policy.get_distribution(torch.from_numpy(seen[None])).mode())
            deviation = float(policy.log_std.exp())
        if mean * side < 0.0:
            halves.append(elapsed)
            stays.append(0.5 * math.erfc(abs(mean) / deviation / math.sqrt(2.0)))
        seen = env.step(torch.tensor([max(-1.0, min(1.0, mean))]).numpy())[0]
    half = statistics.median(halves or [math.inf])
    return Checkpoint(int(folder.name[5:]), half, statistics.median(stays or [math.nan]))
