"""Trainings for `learning`, many at a time, and evaluation of their policies on other fish."""

import itertools
import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import joblib
from msgspec.structs import replace

from common.report import DOCS, progress, spread
from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config, load
from fishd.learning import settings as training
from fishd.learning.env.evaluation import Evaluation, judge
from fishd.learning.ppo import DeterministicPolicy
from fishd.learning.run_folder.checkpoints import load_policy
from fishd.learning.run_folder.tables import best_so_far, read_evaluations
from fishd.learning.settings import TrainingSettings
from fishd.learning.train.jobs import Job
from fishd.learning.train.training import train

CONFIG = DOCS.parent / "config"
UNTOUCHED = range(240, 250)
"""Seeds that no setting was chosen with."""
OFF = 0.15
"""Relative change of each of four parameters of a fish, up or down."""
SECONDS, SETTLE = 60.0, 10.0
"""Length of an evaluation on other fish, and of its ignored start [s]."""


class Row(NamedTuple):
    """Training with several seeds."""

    config: Config
    settings: TrainingSettings
    camera: SimulatedCameraSettings = SimulatedCameraSettings()
    """Camera, where the settings require pictures."""


class Trained(NamedTuple):
    """Result of one training."""

    points: list[Evaluation]
    best: list[float]
    """Relative thrust of the best policy up to each step."""
    others: list[float]
    """Relative thrusts of its best policy on changed fish, if requested."""
    cost: float
    """Processor time for 1000 steps, including evaluations [s]."""

    def steps_to(self, relative_thrust: float) -> float:
        """Return the steps until the first evaluation with that relative thrust; inf without."""
        reached = zip(self.points, self.best, strict=True)
        return next((point.steps for point, best in reached if best >= relative_thrust), math.inf)

    @property
    def exported(self) -> Evaluation:
        """Evaluation of its best policy."""
        return max(self.points, key=lambda point: point.relative_thrust)


def rig(amplitude: float = 0.42) -> Config:
    """Return a fish with 1 mN of noise and an offset of 5 mN on F_y."""
    keys = ("simulation.noise=0.001", "simulation.offset_y=0.005")
    return load(None, [f"amplitude_limit={amplitude}", *keys])


def settings_of(name: str | None, steps: int | None = None) -> TrainingSettings:
    """Return the settings in a file of config/, or the defaults, with another number of steps.

    A training runs all steps, so that learning curves can be compared.
    """
    chosen = training.load(CONFIG / name if name else None)
    evaluation = replace(chosen.evaluation, patience=None)
    return replace(chosen, steps=steps or chosen.steps, evaluation=evaluation)


def trained(row: Row, seed: int, others: bool) -> Trained:
    """Train once, in a separate process."""
    fish = replace(row.config, simulation=replace(row.config.simulation, seed=seed))
    with tempfile.TemporaryDirectory() as temporary:
        job = Job(
            config=fish,
            settings=replace(row.settings, seed=seed),
            folder=Path(temporary) / "run",
            camera=replace(row.camera, seed=seed),
        )
        begun = time.process_time()
        outcome = train(job)
        spent = time.process_time() - begun
        cost = 1000.0 * spent / outcome.steps if outcome.steps else math.nan
        points = read_evaluations(job.folder)
        so_far = best_so_far(points)
        if not others:
            return Trained(points, so_far, [], cost)
        assert outcome.best
        return Trained(points, so_far, swum(outcome.best, row.config), cost)


def swum(checkpoint: Path, config: Config) -> list[float]:
    """Return the relative thrust of a policy on each changed fish."""
    thrusts = []
    for off in fish_that_are_off(config):
        decide = DeterministicPolicy(*load_policy(checkpoint), config.amplitude_limit)
        thrusts.append(judge(off, decide, SECONDS, SETTLE).relative_thrust)
    return thrusts


def fish_that_are_off(config: Config) -> Iterator[Config]:
    """Return sixteen fish with each of four parameters changed up or down."""
    for signs in itertools.product((-1.0, 1.0), repeat=4):
        plant = config.plant
        values = (plant.omega0, plant.xi, plant.servo_speed, plant.coupling)
        omega0, xi, speed, coupling = (
            value * (1.0 + OFF * sign) for value, sign in zip(values, signs, strict=True)
        )
        off = replace(plant, omega0=omega0, xi=xi, servo_speed=speed, coupling=coupling)
        yield replace(config, plant=off, simulation=replace(config.simulation, seed=1000))


def several(
    rows: Mapping[str, Row], seeds: Sequence[int], jobs: int, others: bool = False
) -> dict[str, list[Trained]]:
    """Run all seeds of all rows in parallel."""
    tasks = [(row, seed) for row in rows for seed in seeds]
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator")
        work = parallel(joblib.delayed(trained)(rows[row], seed, others) for row, seed in tasks)
        trainings: dict[str, list[Trained]] = {row: [] for row in rows}
        for (row, seed), result in zip(tasks, work, strict=True):
            trainings[row].append(result)
            last = result.points[-1]
            progress(f"{row}, seed {seed}: {last.relative_thrust:.1%}, best {result.best[-1]:.1%}")
    return trainings


def to_reach(runs: list[Trained], share: float) -> list[str]:
    """Return the cells of a row: steps to that relative thrust, and number of seeds with it."""
    steps = [one.steps_to(share) for one in runs]
    reached = sum(map(math.isfinite, steps))
    return [spread(steps, 1.0, 0).replace("inf", "never"), f"{reached} of {len(runs)}"]
