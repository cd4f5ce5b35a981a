"""The registration of the environments with `gymnasium.make`."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fishd.config import adopt, load
from fishd.core.errors import ConfigError
from fishd.learning.settings import load as load_settings

if TYPE_CHECKING:
    from fishd.learning.env.environment import SwimEnv


def register() -> None:
    """Register both environments with Gymnasium, if it is installed: comparisons do not need it."""
    try:
        import gymnasium
    except ModuleNotFoundError:
        return
    module = __name__
    gymnasium.register("fishd/Swim-v0", entry_point=f"{module}:swim")
    gymnasium.register(
        "fishd/SwimOnDaemon-v0", entry_point=f"{module}:swim_on_daemon", nondeterministic=True
    )


def swim(
    config: str | Path | None = None,
    settings: str | Path | None = None,
    overrides: Iterable[str] = (),
    camera: str | Path | None = None,
    render_mode: str | None = None,
) -> "SwimEnv":
    """Return the environment of a simulated fish in this process, on the virtual clock.

    config, overrides: configuration as for fishd, a YAML file and `KEY=VALUE`s; by default the
        default fish
    settings: YAML file of a training, of which `see`, `environment`, `camera` and `randomisation`
        are used; a feature extractor that must be fitted is fitted to a random excitation first
    camera: YAML file of the simulated camera, for settings with `see: camera` or `both`
    render_mode: `rgb_array` for pictures of the fish from above; None for none

    Raises `ConfigError`.
    """
    if render_mode not in (None, "rgb_array"):
        raise ConfigError(
            f"render_mode={render_mode!r} is not valid: 'rgb_array' is needed, or none; the "
            "wrapper RenderCollection collects its pictures, RecordVideo writes them"
        )
    from fishd.camera import settings as cameras
    from fishd.learning.env.environment import SwimEnv
    from fishd.learning.env.fish_variation import episode_fish
    from fishd.learning.extractors import make_extractor
    from fishd.learning.links.simulated_link import Camera, SimulatedLink

    fish = load(config, overrides)
    chosen = load_settings(settings)
    extractor = make_extractor(chosen)
    sight = Camera(cameras.load_simulated(camera), chosen.camera.stack) if extractor else None
    metered = bool(chosen.seen.power_price)
    link = SimulatedLink(fish, episode_fish(chosen.randomisation), sight, metered=metered)
    truth = link.truth if render_mode else None
    env = SwimEnv(link, fish, chosen.seen, extractor, truth)
    if extractor and not extractor.is_fitted:
        env.reset(seed=0)
        env.excite_randomly(chosen.seed, chosen.camera.random_excitation)
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
    render_mode: str | None = None,
) -> "SwimEnv":
    """Return the environment of the fish of a running fishd; it holds the lease until it is closed.

    endpoint: control socket of fishd; None looks for the fishd of this machine
    config, overrides: configuration that the scales are computed from; by default that of fishd
    agent: address at which fishd reaches this process, as for `Agent`; None: any free port of
        this machine
    camera: request address of the camera, for settings with `see: camera` or `both`
    experiment: name of the lease, as `fishctl status` shows it
    take: whether to take the fish from an experiment that holds it
    render_mode: None, as nothing draws a fish whose true angles are unknown

    Raises `ConfigError`, also where tick or Φ differ from those of fishd, and `FishError`.
    """
    if render_mode is not None:
        raise ConfigError(
            f"render_mode={render_mode!r} is not valid: the true angles of this fish are unknown; "
            "leave it out, and see the fish with 'fishctl watch'"
        )
    from fishd.learning.env.environment import SwimEnv
    from fishd.learning.extractors import make_extractor
    from fishd.learning.links.fishd_link import FishdLink, config_of

    chosen = load_settings(settings)
    fish = load(config, overrides) if config else adopt(config_of(endpoint), overrides)
    extractor = make_extractor(chosen)
    stack = chosen.camera.stack if extractor else None
    link = FishdLink(endpoint, experiment, take, address=agent, stack=stack, camera=camera)
    try:
        env = SwimEnv(link, fish, chosen.seen, extractor)
        if extractor and not extractor.is_fitted:
            env.reset()
            env.excite_randomly(chosen.seed, chosen.camera.random_excitation)
        return env
    except BaseException:
        link.close()
        raise
