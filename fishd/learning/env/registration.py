"""The environments as `gymnasium.make` knows them."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fishd.config import adopt, load
from fishd.learning import settings as training

if TYPE_CHECKING:
    from fishd.learning.env.environment import SwimEnv


def register() -> None:
    """Register both with Gymnasium, where it is installed: comparing controllers needs it not."""
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
    from fishd.learning.env.environment import SwimEnv
    from fishd.learning.env.simulated_link import SimulatedLink

    fish = load(config, overrides)
    chosen = training.load(settings)
    return SwimEnv(SimulatedLink(fish, chosen.randomisation), fish, chosen.environment)


def swim_on_daemon(
    endpoint: str | None = None,
    config: str | Path | None = None,
    settings: str | Path | None = None,
    overrides: Iterable[str] = (),
    agent: str | None = None,
) -> "SwimEnv":
    """The fish of a running fishd; this process acquires control of it when an episode begins.

    endpoint: control socket of the daemon; None looks for the one on this machine
    config, overrides: the configuration that the scales are made for; without a file, that of the
        daemon
    agent: where the daemon can reach this process, as for `Agent`; None: any free port of this
        machine

    Raises `ConfigError`, also where tick or Φ are not the daemon's, and `FishError`.
    """
    from fishd.learning.env.environment import SwimEnv
    from fishd.learning.env.fishd_link import FishdLink, config_of

    chosen = training.load(settings).environment
    fish = load(config, overrides) if config else adopt(config_of(endpoint), overrides)
    link = FishdLink(endpoint, address=agent)
    try:
        return SwimEnv(link, fish, chosen)
    except BaseException:
        link.close()
        raise
