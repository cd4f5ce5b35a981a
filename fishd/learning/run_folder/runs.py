"""The folder of a training: its configuration and settings, written before the first step."""

import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import msgspec
from msgspec import Struct

from fishd import __version__
from fishd import config as configuration
from fishd.camera import settings as cameras
from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config
from fishd.controllers.policy.card import Card, Feature, Provenance
from fishd.core import strict_yaml
from fishd.core.errors import ConfigError
from fishd.core.files import os_errors, write_atomically
from fishd.lab.experiment import On, mark_folder
from fishd.learning import settings as training
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.settings import TrainingSettings

CONFIG, SETTINGS, CAMERA = "config.yaml", "settings.yaml", "camera.yaml"


def create(
    folder: Path,
    config: Config,
    settings: TrainingSettings,
    camera: SimulatedCameraSettings | None = None,
    on: On = "simulation",
    command: Sequence[str] = (),
) -> None:
    """Make a run folder; raises `ConfigError` where it exists already.

    command: arguments of `fishctl learn ppo`
    camera: camera that sees a simulated fish
    """
    with os_errors(ConfigError, f"{folder}: cannot be made"):
        mark_folder(folder, "learn ppo", on, command)
        write_atomically(folder / CONFIG, configuration.to_yaml(config))
        write_settings(folder, settings)
        if camera:
            seen = cameras.CameraSettings(simulated=_without_address(camera))
            write_atomically(folder / CAMERA, cameras.to_yaml(seen))


def write_settings(folder: Path, settings: TrainingSettings) -> None:
    """Write the settings of a run; a resumed run may have more steps."""
    write_atomically(folder / SETTINGS, training.to_yaml(settings))


def read(folder: Path) -> tuple[Config, TrainingSettings]:
    """Read the configuration and settings of a run; raises `ConfigError`."""
    if not (folder / SETTINGS).is_file():
        why = f"it has no {SETTINGS}" if folder.exists() else "it does not exist"
        raise ConfigError(f"{folder}: not the folder of a training: {why}")
    for file, kind in ((folder / CONFIG, Config), (folder / SETTINGS, TrainingSettings)):
        _check_complete(file, kind)
    return configuration.load(folder / CONFIG), training.load(folder / SETTINGS)


def read_camera(folder: Path) -> SimulatedCameraSettings:
    """Read the settings of the simulated camera of a run; raises `ConfigError`."""
    return cameras.load(folder / CAMERA).simulated


def _without_address(camera: SimulatedCameraSettings) -> cameras.SimulatedSettings:
    names = SimulatedCameraSettings.__struct_fields__
    return cameras.SimulatedSettings(**{name: getattr(camera, name) for name in names})


def _check_complete(file: Path, kind: type[Struct]) -> None:
    """Refuse a file with missing keys: defaults may not be those that the run began with."""
    data, _ = strict_yaml.read(file, "a run", "steps: 8000")
    missing = [key for key in kind.__struct_fields__ if key not in data]
    if missing:
        raise ConfigError(f"{file}: incomplete: the key {missing[0]} is missing")


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
    """Return the card of a policy.

    on: simulation, robot or another word for the fish that swam
    steps: number of control steps that it has learned from
    evaluation: latest evaluation
    """
    libraries = {name: version(name) for name in _LIBRARIES}
    imitation = ["imitation"] if settings.imitation.rounds else []
    algorithms = [*imitation, "PPO"] if settings.steps else imitation
    return Card(
        observation=features,
        history=settings.environment.history,
        pictures=settings.camera.stack if settings.see != "force" else None,
        tick=config.tick,
        amplitude=config.amplitude_limit,
        provenance=Provenance(
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            fishd=__version__,
            algorithm=" and ".join(algorithms),
            on=on,
            steps=steps,
            seed=settings.seed,
            settings=msgspec.to_builtins(settings),
            plant=msgspec.to_builtins(config.plant),
            libraries={"python": platform.python_version(), **libraries},
            relative_thrust=evaluation.relative_thrust if evaluation else None,
            frequency=evaluation.frequency if evaluation else None,
            note=note,
        ),
    )
