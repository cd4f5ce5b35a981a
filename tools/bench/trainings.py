"""Trainings for `learning`: many at a time, and what their policies do on other fish."""

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
from fishd.camera.simulated.settings import SimulatedCameraSettings
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
"""By this share each of four parameters of a fish is off, up or down."""
SECONDS, SETTLE = 60.0, 10.0
"""How long policies and controllers are judged on other fish, and not judged at first [s]."""


class Row(NamedTuple):
    """What is trained with several seeds."""

    config: Config
    settings: TrainingSettings
    camera: SimulatedCameraSettings = SimulatedCameraSettings()
    """What the fish is seen with, where the settings ask for pictures."""


class Trained(NamedTuple):
    """One training."""

    points: list[Evaluation]
    best: list[float]
    """Relative thrust of the best policy until each of them."""
    others: list[float]
    """Relative thrusts of its best policy on fish that are off, if those were asked for."""
    cost: float
    """Seconds of the processor for 1000 steps, evaluations included."""

    def steps_to(self, relative_thrust: float) -> float:
        """Steps before the first evaluation with that relative thrust; inf if there is none."""
        reached = zip(self.points, self.best, strict=True)
        return next((point.steps for point, best in reached if best >= relative_thrust), math.inf)

    @property
    def exported(self) -> Evaluation:
        """The evaluation of its best policy."""
        return max(self.points, key=lambda point: point.relative_thrust)


def rig(amplitude: float = 0.42) -> Config:
    """A fish of which F_y has 1 mN of noise and an offset of 5 mN."""
    keys = ("simulation.noise=0.001", "simulation.offset_y=0.005")
    return load(None, [f"amplitude_limit={amplitude}", *keys])


def settings_of(name: str | None, steps: int | None = None) -> TrainingSettings:
    """Those of a file in config/, or the defaults; with another number of steps.

    A training does all steps, so that learning curves can be compared.
    """
    chosen = training.load(CONFIG / name if name else None)
    evaluation = replace(chosen.evaluation, patience=None)
    return replace(chosen, steps=steps or chosen.steps, evaluation=evaluation)


def trained(row: Row, seed: int, others: bool) -> Trained:
    """Train once; in a process of its own."""
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
    """Relative thrust of a policy on each fish that is off."""
    found = []
    for off in fish_that_are_off(config):
        decide = DeterministicPolicy(*load_policy(checkpoint), config.amplitude_limit)
        found.append(judge(off, decide, SECONDS, SETTLE).relative_thrust)
    return found


def fish_that_are_off(config: Config) -> Iterator[Config]:
    """Sixteen: each of four parameters is off, up or down."""
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
    """All seeds of all rows, in parallel."""
    tasks = [(row, seed) for row in rows for seed in seeds]
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=jobs, batch_size=1, return_as="generator")
        work = parallel(joblib.delayed(trained)(rows[row], seed, others) for row, seed in tasks)
        found: dict[str, list[Trained]] = {row: [] for row in rows}
        for (row, seed), result in zip(tasks, work, strict=True):
            found[row].append(result)
            last = result.points[-1]
            progress(f"{row}, seed {seed}: {last.relative_thrust:.1%}, best {result.best[-1]:.1%}")
    return found


def to_reach(runs: list[Trained], share: float) -> list[str]:
    """The cells of a row: steps to that relative thrust, and how many seeds reached it."""
    steps = [one.steps_to(share) for one in runs]
    reached = sum(map(math.isfinite, steps))
    return [spread(steps, 1.0, 0).replace("inf", "never"), f"{reached} of {len(runs)}"]
