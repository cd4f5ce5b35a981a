"""The card of a policy in training: what is needed to run it, and where it comes from."""

import platform
from datetime import UTC, datetime
from importlib.metadata import version

import msgspec

from fishd import __version__
from fishd.config import Config
from fishd.controllers.policy.card import Card, Feature, Provenance
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.settings import TrainingSettings

_LIBRARIES = ("torch", "stable-baselines3", "gymnasium", "numpy")


def make_card(
    config: Config,
    settings: TrainingSettings,
    features: tuple[Feature, ...],
    on: str,
    steps: int,
    evaluation: Evaluation | None,
    note: str,
) -> Card:
    """
    on: simulation, robot or another word for what swam
    steps: control steps that it has learned from
    evaluation: the latest
    """
    libraries = {name: version(name) for name in _LIBRARIES}
    return Card(
        observation=features,
        tick=config.tick,
        amplitude=config.amplitude_limit,
        provenance=Provenance(
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            fishd=__version__,
            algorithm="PPO",
            on=on,
            steps=steps,
            seed=settings.seed,
            settings=msgspec.to_builtins(settings),
            plant=msgspec.to_builtins(config.plant),
            libraries={"python": platform.python_version(), **libraries},
            efficiency=evaluation.efficiency if evaluation else None,
            frequency=evaluation.frequency if evaluation else None,
            note=note,
        ),
    )
