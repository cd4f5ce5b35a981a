"""How well does it swim? The same judgement for a policy in training as for any controller."""

from collections.abc import Callable

from msgspec import Struct
from msgspec.structs import replace

from fishd import simulation
from fishd.config import Config, Start
from fishd.controllers.base import Controller
from fishd.learning.in_process import Silence
from fishd.plant.optimum import SteadyState, square_wave
from fishd.signals import Observation
from fishd.simulation import Report

_GRID_HZ = (0.2, 10.0)
"""Whole-tick square waves are sought between these frequencies."""


class _NoParameters(Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Decided(Controller[_NoParameters]):
    """A plain function in command."""

    Parameters = _NoParameters
    decide: Callable[[Observation], float]

    def update(self, observation: Observation) -> float:
        """What the function answers [rad]."""
        return self.decide(observation)


def judge(
    config: Config,
    decide: Callable[[Observation], float],
    seconds: float,
    settle: float,
    name: str = "policy",
) -> Report:
    """Let a function swim the simulated fish of `config`, from rest, and judge it.

    decide: observation in, instruction angle out [rad]; called once a tick
    seconds, settle: as for `fishd.simulation.simulate` [s]
    Raises `ParameterError` where the lengths do not fit one another.
    """
    config = replace(config, robot="simulated", start=Start())
    controller = Decided(_NoParameters(), config.limits)
    controller.decide = decide
    return simulation.judge(config, name, controller, seconds, settle, Silence())


def best_on_grid(config: Config) -> SteadyState:
    """The best square wave whose half periods are whole ticks: what a loop can reach at best.

    (But for waves whose half periods alternate between two lengths.)
    """
    lowest, highest = _GRID_HZ
    fewest = max(1, round(0.5 / highest / config.tick))
    most = max(fewest, round(0.5 / lowest / config.tick))
    waves = (
        square_wave(config.plant, config.amplitude_limit, 0.5 / (ticks * config.tick))
        for ticks in range(fewest, most + 1)
    )
    return max(waves, key=lambda wave: wave.thrust)
