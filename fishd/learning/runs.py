"""The folder of a training: its configuration and settings, written before the first step."""

from datetime import datetime
from pathlib import Path

from fishd import config as configuration
from fishd.config import Config
from fishd.errors import ConfigError
from fishd.learning import settings as training
from fishd.learning.settings import TrainingSettings

CONFIG, SETTINGS = "config.yaml", "settings.yaml"


def default_folder() -> Path:
    """A new name under runs/, from date and time."""
    return Path("runs") / f"ppo-{datetime.now():%Y%m%d-%H%M%S}"


def create(folder: Path, config: Config, settings: TrainingSettings) -> None:
    """Make a run folder; raises `ConfigError` where something is there already."""
    make_folder(folder, f", or go on with --resume {folder}")
    try:
        (folder / CONFIG).write_text(configuration.to_yaml(config), encoding="utf-8")
        keep_settings(folder, settings)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror}") from None


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
    (folder / SETTINGS).write_text(training.to_yaml(settings), encoding="utf-8")


def read(folder: Path) -> tuple[Config, TrainingSettings]:
    """Configuration and settings of a run; raises `ConfigError`."""
    if not (folder / SETTINGS).is_file():
        raise ConfigError(f"{folder}: no folder of a training: it holds no {SETTINGS}")
    return configuration.load(folder / CONFIG), training.load(folder / SETTINGS)
