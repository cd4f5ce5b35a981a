"""Puts the parts together: from a configuration to a loop that is ready to tick."""

from fishd.clock import Clock
from fishd.config import Config
from fishd.controllers import registry
from fishd.estimators.lateral_force import LateralForceEstimator
from fishd.guard import Guard
from fishd.hardware.base import Robot
from fishd.hardware.simulated import SimulatedFish
from fishd.loop import ControlLoop
from fishd.reporting import Publisher


def build_robot(config: Config) -> Robot:
    """The robot that the configuration describes."""
    return SimulatedFish(config.plant, config.simulation, config.tick).robot()


def build_loop(config: Config, robot: Robot, clock: Clock, publisher: Publisher) -> ControlLoop:
    """A loop in which `config.start.controller` is in command, if there is one.

    Raises `UnknownController` and `ParameterError`, neither for a configuration from `load`.
    """
    loop = ControlLoop(
        robot=robot,
        estimator=LateralForceEstimator(config.estimator),
        guard=Guard(config.amplitude_limit, config.tick, config.slew_limit, config.fade_time),
        limits=config.limits,
        clock=clock,
        publisher=publisher,
    )
    start = config.start
    if start.controller is not None:
        controller = registry.create(start.controller, start.parameters, config.limits)
        loop.set_controller(start.controller, controller)
    return loop
