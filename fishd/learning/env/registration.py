"""The environments as `gymnasium.make` knows them."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fishd.config import adopt, load
from fishd.learning import settings as training

if TYPE_CHECKING:
    from fishd.learning.env.environment import SwimEnv


def register() -> None:
    """Register both with Gymnasium if it is installed: comparing controllers works without it."""
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
    camera: str | Path | None = None,
) -> "SwimEnv":
    """A simulated fish in this process, on the virtual clock.

    config, overrides: as for fishd, a YAML file and `KEY=VALUE`s; by default the default fish
    settings: YAML file of a training, of which `see`, `environment`, `camera` and `randomisation`
        count; an eye that has to learn to see babbles first
    camera: YAML file of the simulated camera, where the settings say `see: camera` or `both`

    Raises `ConfigError`.
    """
    from fishd.camera import settings as cameras
    from fishd.learning.env.environment import SwimEnv
    from fishd.learning.env.simulated_link import Camera, SimulatedLink
    from fishd.learning.eyes.making import make

    fish = load(config, overrides)
    chosen = training.load(settings)
    eye = make(chosen)
    sight = Camera(cameras.simulated(camera), chosen.camera.stack) if eye else None
    metered = bool(chosen.seen.power_price)
    link = SimulatedLink(fish, chosen.randomisation, sight, metered=metered)
    env = SwimEnv(link, fish, chosen.seen, eye)
    if eye and not eye.is_fitted:
        env.reset(seed=0)
        env.babble(chosen.seed, chosen.camera.babble)
    return env


def swim_on_daemon(
    endpoint: str | None = None,
    config: str | Path | None = None,
    settings: str | Path | None = None,
    overrides: Iterable[str] = (),
    agent: str | None = None,
    camera: str | None = None,
    experiment: str = "environment",
    take: bool = False,
) -> "SwimEnv":
    """The fish of a running fishd, whose lease this process holds until the environment is closed.

    endpoint: control socket of the daemon; None looks for the one on this machine
    config, overrides: the configuration that the scales are made for; without a file, that of the
        daemon
    agent: where the daemon can reach this process, as for `Agent`; None: any free port of this
        machine
    camera: where its camera takes requests, where the settings say `see: camera` or `both`
    experiment: what the lease is called, as `fishctl status` shows it
    take: take the fish from an experiment that holds it

    Raises `ConfigError`, also where tick or Φ are not the daemon's, and `FishError`.
    """
    from fishd.learning.env.environment import SwimEnv
    from fishd.learning.env.fishd_link import FishdLink, config_of
    from fishd.learning.eyes.making import make

    chosen = training.load(settings)
    fish = load(config, overrides) if config else adopt(config_of(endpoint), overrides)
    eye = make(chosen)
    stack = chosen.camera.stack if eye else None
    link = FishdLink(endpoint, experiment, take, address=agent, stack=stack, camera=camera)
    try:
        env = SwimEnv(link, fish, chosen.seen, eye)
        if eye and not eye.is_fitted:
            env.reset()
            env.babble(chosen.seed, chosen.camera.babble)
        return env
    except BaseException:
        link.close()
        raise
