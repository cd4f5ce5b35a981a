"""Trains a policy on the cloud of fish that a fit leaves possible, in simulation."""

import shutil
from collections.abc import Callable
from pathlib import Path

from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.core.errors import PolicyError
from fishd.learning.adapt.state import POLICY, TRAINING, Fitted, Trained
from fishd.learning.export import export
from fishd.learning.settings import (
    EnvironmentSettings,
    EvaluationSettings,
    PpoSettings,
    Randomisation,
    TrainingSettings,
)
from fishd.learning.train.jobs import Job
from fishd.learning.train.progress import Display
from fishd.learning.train.training import train
from fishd.virtual.plant.optimum import best_square_wave

EPISODE = 128
"""Steps with one fish of the cloud; then the next one is drawn."""
NOISE = 0.3
"""More noise of a tick than this share of the best thrust would drown the reward."""
EVERY, OTHERS = 5, 3
"""Evaluations after so many updates, on the identified fish and so many others of the cloud."""


def settings(fitted: Fitted, steps: int, seed: int) -> TrainingSettings:
    """How the policy is trained."""
    return TrainingSettings(
        steps=steps,
        seed=seed,
        checkpoint_every=max(1, steps),
        environment=EnvironmentSettings(episode=EPISODE),
        randomisation=Randomisation(fish=fitted.cloud, offset=min(10.0, fitted.offset)),
        ppo=PpoSettings(decay_steps=max(1, steps)),
        evaluation=EvaluationSettings(every=EVERY, others=OTHERS),
    )


def simulated(config: Config, fitted: Fitted) -> Config:
    """The identified fish on its rig, with the loop of the real one."""
    best = best_square_wave(fitted.plant, config.amplitude_limit).thrust
    rig = replace(fitted.rig, noise=min(fitted.rig.noise, NOISE * best))
    return replace(config, robot="simulated", plant=fitted.plant, simulation=rig, start=Start())


def practise(
    config: Config,
    fitted: Fitted,
    folder: Path,
    steps: int,
    seed: int,
    progress: Callable[[int], None],
) -> Trained:
    """Train, and write the policy that did best on its worst fish into the folder.

    config: the loop of the fish: its tick, Φ and limits; of its plant and rig nothing is used
    folder: of the adaptation; a training in it that was broken off is done anew
    progress: called with the steps that are done
    """
    place = folder / TRAINING
    if place.exists():
        shutil.rmtree(place)
    job = Job(
        config=simulated(config, fitted), settings=settings(fitted, steps, seed), folder=place
    )
    outcome = train(job, _Steps(progress))
    best = outcome.best_evaluation
    if outcome.best is None or best is None:
        why = outcome.message or "in no evaluation did it swim"
        return Trained(steps=outcome.steps, refused=f"nothing came of the training: {why}")
    try:
        export(outcome.best, folder / POLICY, note="of fishctl adapt")
    except PolicyError as error:
        return Trained(steps=outcome.steps, refused=str(error))
    return Trained(steps=best.steps, efficiency=best.efficiency, worst=best.worst)


class _Steps(Display):
    """Counts the steps of a training."""

    def __init__(self, progress: Callable[[int], None]) -> None:
        self._progress = progress
        self._done = 0

    def step(self, tank_time: float) -> None:
        """One more."""
        self._done += 1
        self._progress(self._done)
