"""Puts the parts together: from a configuration and a robot to a loop that is ready to tick."""

from collections.abc import Callable

from fishd.clock import Clock
from fishd.config import Config
from fishd.controllers import registry
from fishd.estimators.lateral_force import LateralForceEstimator
from fishd.guard import Guard
from fishd.hardware import pulses
from fishd.hardware.base import Robot
from fishd.hardware.calibration import calibrated
from fishd.loop import ControlLoop
from fishd.reporting import Publisher


def build_loop(
    config: Config,
    robot: Robot,
    clock: Clock,
    publisher: Publisher,
    notify: Callable[[float], None] = lambda now: None,
) -> ControlLoop:
    """A loop in which `config.start.controller` is in command, if there is one.

    notify: called at the end of every tick with the time of its start [s, monotonic]
    Raises `UnknownController` and `ParameterError`, neither for a configuration from `load`.
    """
    guard = Guard(config.amplitude_limit, config.tick, config.slew_limit, config.fade_time)
    if robot.bench:
        guard.restrict(*pulses.reach(calibrated(config.servo, robot.bench.servo.calibration)))
    loop = ControlLoop(
        robot=robot,
        estimator=LateralForceEstimator(config.estimator),
        guard=guard,
        limits=config.limits,
        clock=clock,
        publisher=publisher,
        notify=notify,
    )
    start = config.start
    if start.controller is not None:
        controller = registry.create(start.controller, start.parameters, config.limits)
        loop.set_controller(start.controller, controller)
    return loop
