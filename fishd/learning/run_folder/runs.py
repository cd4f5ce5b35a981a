"""The folder of a training: its configuration and settings, written before the first step."""

from datetime import datetime
from pathlib import Path

from msgspec import Struct

from fishd import config as configuration
from fishd import files, strict_yaml
from fishd.config import Config
from fishd.errors import ConfigError
from fishd.learning import settings as training
from fishd.learning.settings import TrainingSettings
from fishd.learning.whole import write_whole

CONFIG, SETTINGS = "config.yaml", "settings.yaml"


def default_folder() -> Path:
    """A new name under runs/, from date and time."""
    return Path("runs") / f"ppo-{datetime.now():%Y%m%d-%H%M%S}"


def create(folder: Path, config: Config, settings: TrainingSettings) -> None:
    """Make a run folder; raises `ConfigError` where something is there already."""
    otherwise = f", or go on with --resume {folder}" if has_checkpoint(folder) else ""
    if not otherwise and (folder / CONFIG).exists():
        otherwise = ", or remove it: the training in it ended before its first checkpoint"
    make_folder(folder, otherwise)
    try:
        write_whole(folder / CONFIG, configuration.to_yaml(config))
        keep_settings(folder, settings)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}") from None


def has_checkpoint(folder: Path) -> bool:
    """Is there something in a run folder from which --resume could go on?"""
    return any(path.is_dir() for kind in ("step-*", "best-*") for path in folder.glob(kind))


def make_folder(folder: Path, otherwise: str = "") -> None:
    """Make a folder, or use an empty one.

    otherwise: what can be done where it is not empty, other than to take another one

    Raises `ConfigError`.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ConfigError(f"{folder} is there already; give another --folder{otherwise}")
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}") from None


def keep_settings(folder: Path, settings: TrainingSettings) -> None:
    """Write the settings of a run; a resumed one may go on for longer."""
    write_whole(folder / SETTINGS, training.to_yaml(settings))


def read(folder: Path) -> tuple[Config, TrainingSettings]:
    """Configuration and settings of a run; raises `ConfigError`."""
    if not (folder / SETTINGS).is_file():
        raise ConfigError(f"{folder}: no folder of a training: it holds no {SETTINGS}")
    for file, kind in ((folder / CONFIG, Config), (folder / SETTINGS, TrainingSettings)):
        _check_whole(file, kind)
    return configuration.load(folder / CONFIG), training.load(folder / SETTINGS)


def _check_whole(file: Path, kind: type[Struct]) -> None:
    """Nothing in a run is left to defaults, which may not be those that it began with."""
    try:
        data = strict_yaml.parse(files.read_text(file, files.SETTINGS, "a run")).data
    except (files.FileProblem, strict_yaml.YamlProblem):
        return  # which `load` says better
    missing = [
        key for key in kind.__struct_fields__ if not isinstance(data, dict) or key not in data
    ]
    if missing:
        raise ConfigError(f"{file}: not the whole file of a run: {missing[0]} is missing")
