"""The environments as `gymnasium.make` knows them."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fishd.config import load
from fishd.learning import settings as training
from fishd.learning.settings import EnvironmentSettings

if TYPE_CHECKING:
    from fishd.learning.environment import SwimEnv


def register() -> None:
    """Tell Gymnasium; without it, there is nobody to tell, and controllers can still be judged."""
    try:
        import gymnasium
    except ModuleNotFoundError:
        return
    here = __name__
    gymnasium.register("fishd/Swim-v0", entry_point=f"{here}:swim")
    gymnasium.register(
        "fishd/SwimOnDaemon-v0", entry_point=f"{here}:swim_on_daemon", nondeterministic=True
    )


def swim(
    config: str | Path | None = None,
    settings: str | Path | None = None,
    overrides: Iterable[str] = (),
) -> "SwimEnv":
    """A simulated fish in this process, on the virtual clock.

    config, overrides: as for fishd, a YAML file and `KEY=VALUE`s; by default the default fish
    settings: YAML file of a training, of which `environment` and `randomisation` count

    Raises `ConfigError`.
    """
    from fishd.learning.environment import SwimEnv
    from fishd.learning.links import in_process

    fish = load(_path(config), overrides)
    chosen = training.load(_path(settings))
    return SwimEnv(in_process(fish, chosen), fish, chosen.environment)


def swim_on_daemon(
    endpoint: str | None = None,
    config: str | Path | None = None,
    settings: str | Path | None = None,
    overrides: Iterable[str] = (),
    agent: str | None = None,
) -> "SwimEnv":
    """The fish of a running fishd; this process takes command of it when an episode begins.

    endpoint: control socket of the daemon; None looks for the one on this machine
    config, overrides: what the daemon was given, for the scales; without a file, tick and Φ are
        those of the daemon
    agent: where the daemon can reach this process, as for `Agent`; None: any free port of this
        machine

    Raises `ConfigError`, also where tick or Φ are not the daemon's, and `FishError`.
    """
    from fishd.learning.environment import SwimEnv
    from fishd.learning.links import check_agreement, daemon_config, on_daemon

    chosen: EnvironmentSettings = training.load(_path(settings)).environment
    fish = daemon_config(endpoint, _path(config), overrides)
    link = on_daemon(endpoint, agent)
    try:
        check_agreement(link, fish)
        return SwimEnv(link, fish, chosen)
    except BaseException:
        link.close()
        raise


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
