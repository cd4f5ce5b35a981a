"""Scales that bring the agent's inputs and reward near 1 for the configured fish.

They come from the physics, not from running averages: nothing drifts during training, and a policy
file carries a few numbers that a person can check.
"""

from fishd.config import Config
from fishd.controllers.policy.card import Feature, FeatureName
from fishd.learning.settings import EnvironmentSettings
from fishd.virtual.plant.optimum import best_square_wave


def best_thrust(config: Config) -> float:
    """Mean thrust of the best square wave of the configured fish [N]."""
    return float(best_square_wave(config.plant, config.amplitude_limit).thrust)


def thrust_scale(config: Config, settings: EnvironmentSettings) -> float:
    """The thrust that is rewarded with `reward_scale` [N]."""
    return settings.thrust_scale or best_thrust(config)


def force_scale(config: Config) -> float:
    """K λ ω₀² Φ [N]: the reaction to a fin that is held at λΦ and let go (Fu et al., F_y)."""
    plant = config.plant
    return plant.thrust_coefficient * plant.coupling * plant.omega0**2 * config.amplitude_limit


def features(config: Config, settings: EnvironmentSettings) -> tuple[Feature, ...]:
    """The inputs of the network, each with the value that it sees as 1."""
    force = settings.force_scale or force_scale(config)
    omega0 = config.plant.omega0
    scales: dict[FeatureName, float] = {
        "fx": thrust_scale(config, settings),
        "fy": force,
        "fy_rate": force * omega0,
        "fin_velocity": force / omega0,  # the estimate is an integral of F_y
        "instruction_angle": config.amplitude_limit,
        "previous_angle": config.amplitude_limit,
    }
    return tuple(Feature(name, scales[name]) for name in settings.observation)
