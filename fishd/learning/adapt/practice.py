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
"""Steps with one fish of the cloud; then the next one is drawn."""
NOISE = 0.3
"""More noise of a tick than this share of the best thrust would drown the reward."""
GOOD, TRIES = 0.97, 3
"""A policy is good enough that reaches this share of the best square wave on its worst fish."""
IMITATION_ROUNDS, IMITATION_FISH = 2, 64
"""Before PPO it imitates the best square waves of so many draws from the cloud in each round; PPO
alone may stay at a wave of one tick too few or too many."""
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
        imitation=ImitationSettings(rounds=IMITATION_ROUNDS, fish=IMITATION_FISH),
        ppo=PpoSettings(decay_steps=max(1, steps)),
        evaluation=EvaluationSettings(every=EVERY, others=OTHERS, patience=None),
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

    Where that reaches less than `GOOD`, it is trained anew with the next seed, `TRIES` times at
    most, and the best of all is taken.

    config: the loop of the fish: its tick, Φ and limits; of its plant and rig nothing is used
    folder: of the adaptation; a training in it that was broken off is done anew
    progress: called with the steps that are done
    """
    best: Outcome | None = None
    display = _Steps(progress)
    message = "in no evaluation did it swim"
    for index in range(TRIES):
        place = folder / (TRAINING if index == 0 else f"{TRAINING}-{index + 1}")
        if place.exists():
            shutil.rmtree(place)
        task = settings(fitted, steps, (seed + index) % 2**32)
        outcome = train(Job(config=simulated(config, fitted), settings=task, folder=place), display)
        message = outcome.message or message
        if outcome.best and (best is None or _merit(outcome) > _merit(best)):
            best = outcome
        if best and _merit(best) >= GOOD:
            break
    if best is None or best.best is None or best.best_evaluation is None:
        return Trained(steps=display.steps, refused=f"nothing came of the training: {message}")
    try:
        export(best.best, folder / POLICY, note="of fishctl adapt")
    except PolicyError as error:
        return Trained(steps=display.steps, refused=str(error))
    found = best.best_evaluation
    return Trained(
        steps=display.steps,
        folder=best.folder.name,
        relative_thrust=found.relative_thrust,
        worst=found.worst,
    )


def _merit(outcome: Outcome) -> float:
    return outcome.best_evaluation.merit if outcome.best_evaluation else 0.0


class _Steps(Display):
    """Counts the steps of all trainings."""

    def __init__(self, progress: Callable[[int], None]) -> None:
        self._progress = progress
        self.steps = 0

    def step(self, tank_time: float) -> None:
        """One more."""
        self.steps += 1
        self._progress(self.steps)
