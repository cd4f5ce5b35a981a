"""Training of a policy in simulation, on the cloud of fish that agree with a fit."""

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
    ImitationSettings,
    PpoSettings,
    Randomisation,
    TrainingSettings,
)
from fishd.learning.train.jobs import Job, Outcome
from fishd.learning.train.progress import Display
from fishd.learning.train.training import train
from fishd.virtual.plant.optimum import best_square_wave

EPISODE = 128
"""Steps per episode; each episode swims one fish of the cloud."""
MAX_NOISE = 0.3
"""Largest noise of a tick in the training, as a share of the best thrust; more would hide the
reward."""
GOOD_MERIT, MAX_TRAININGS = 0.97, 3
"""Merit with which a policy is good enough, as a share of the best square wave on its worst fish;
and the largest number of trainings."""
IMITATION_ROUNDS, IMITATION_FISH = 2, 64
"""Rounds of imitation before PPO, and draws from the cloud in each round. PPO alone may stay at a
wave that is one tick too short or too long."""
EVALUATION_INTERVAL, OTHER_FISH = 5, 3
"""Updates per evaluation, and number of fish of the cloud evaluated beside the identified one."""


def training_settings(fitted: Fitted, steps: int, seed: int) -> TrainingSettings:
    """Return the settings of the training."""
    return TrainingSettings(
        steps=steps,
        seed=seed,
        checkpoint_every=max(1, steps),
        environment=EnvironmentSettings(episode=EPISODE),
        randomisation=Randomisation(fish=fitted.cloud, offset=min(10.0, fitted.offset)),
        imitation=ImitationSettings(rounds=IMITATION_ROUNDS, fish=IMITATION_FISH),
        ppo=PpoSettings(decay_steps=max(1, steps)),
        evaluation=EvaluationSettings(every=EVALUATION_INTERVAL, others=OTHER_FISH, patience=None),
    )


def simulated_config(config: Config, fitted: Fitted) -> Config:
    """Return the configuration of the identified fish on its rig, with the real fish's loop."""
    best = best_square_wave(fitted.plant, config.amplitude_limit).thrust
    rig = replace(fitted.rig, noise=min(fitted.rig.noise, MAX_NOISE * best))
    return replace(config, robot="simulated", plant=fitted.plant, simulation=rig, start=Start())


def train_policy(
    config: Config,
    fitted: Fitted,
    folder: Path,
    steps: int,
    seed: int,
    progress: Callable[[int], None],
) -> Trained:
    """Train, and write the policy that did best on its worst fish into the folder.

    Where its merit is less than `GOOD_MERIT`, the training is repeated with the next seed. There
    are at most `MAX_TRAININGS` trainings, and the best of all policies is taken.

    config: tick, Φ and limits of the fish; its plant and rig are not used
    folder: folder of the adaptation; an interrupted training in it is restarted
    progress: called with the number of finished steps
    """
    best: Outcome | None = None
    display = _Steps(progress)
    message = "it swam in no evaluation"
    for index in range(MAX_TRAININGS):
        place = folder / (TRAINING if index == 0 else f"{TRAINING}-{index + 1}")
        if place.exists():
            shutil.rmtree(place)
        task = training_settings(fitted, steps, (seed + index) % 2**32)
        outcome = train(
            Job(config=simulated_config(config, fitted), settings=task, folder=place), display
        )
        message = outcome.message or message
        if outcome.best and (best is None or _merit(outcome) > _merit(best)):
            best = outcome
        if best and _merit(best) >= GOOD_MERIT:
            break
    if best is None or best.best is None or best.best_evaluation is None:
        return Trained(steps=display.steps, refused=f"the training gave no policy: {message}")
    try:
        export(best.best, folder / POLICY, note="of fishctl adapt")
    except PolicyError as error:
        return Trained(steps=display.steps, refused=str(error))
    evaluation = best.best_evaluation
    return Trained(
        steps=display.steps,
        folder=best.folder.name,
        relative_thrust=evaluation.relative_thrust,
        worst=evaluation.worst,
    )


def _merit(outcome: Outcome) -> float:
    return outcome.best_evaluation.merit if outcome.best_evaluation else 0.0


class _Steps(Display):
    """A display that counts the steps of all trainings."""

    def __init__(self, progress: Callable[[int], None]) -> None:
        self._progress = progress
        self.steps = 0

    def step(self, tank_time: float) -> None:
        """Count one step."""
        self.steps += 1
        self._progress(self.steps)
