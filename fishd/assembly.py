"""Construction of the robot and its control loop from a configuration, in real or virtual time."""

import dataclasses
import logging
import os
from collections.abc import Callable, Container
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec.structs import replace

from fishd.config import Config
from fishd.config.drivers import claims_of, readings_of
from fishd.control.estimators.base import Estimator
from fishd.control.estimators.fin_sensor import FinSensor
from fishd.control.estimators.lateral_force import LateralForceEstimator
from fishd.control.estimators.lateral_sign import LateralSign
from fishd.control.estimators.live_thrust import LiveThrust
from fishd.control.estimators.observer import Observer
from fishd.control.guard import Guard
from fishd.control.loop import ControlLoop
from fishd.core import files, text
from fishd.core.addresses import virtual_pi_socket
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.clock import Clock, SystemClock, VirtualClock
from fishd.core.errors import FishdError, SensorError, StartupError
from fishd.core.foreign_code import call_foreign
from fishd.core.signals import Publisher, Truth
from fishd.hardware import ownership, release_recipe
from fishd.hardware.base import CalibratedParts, Robot
from fishd.hardware.calibration_files import CalibrationFolder
from fishd.hardware.driver import ServoDriver, read_counters, read_limitations
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor
from fishd.hardware.recipes import Recipes
from fishd.hardware.registry import FORCE_SENSORS, SENSORS, SERVOS, driver_packages
from fishd.hardware.sampler import close_all
from fishd.hardware.servo import pulses
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.pigpio import Pigpio
from fishd.virtual.fish import SimulatedFish

if TYPE_CHECKING:  # most runs need neither drivers nor emulation, so they are loaded on demand
    from fishd.hardware.panel import Panel
    from fishd.hardware.sensors.sampled_readings import SampledReadings
    from fishd.virtual.pi.virtual_pi import VirtualPi

log = logging.getLogger(__name__)

FIRST_SAMPLE_TIMEOUT_S = 1.0
"""Longest wait for the first sample of the force sensor [s]."""


def open_robot(
    config: Config,
    clock: Clock,
    stack: ExitStack,
    file: Path | None = None,
    control: Path | None = None,
) -> Robot:
    """Return the robot in real time; closing `stack` releases its servo first, then the rest.

    file: configuration file, with which `fishd-release` finds the recipe for this servo
    control: control socket, with which `fishctl estop` finds it
    A sensor or servo that does not answer is not an error here: the loop reports it, and recovers
    when the hardware answers again. Raises `StartupError` when a package is missing, no virtual Pi
    is running or another fishd drives this robot, and `ConfigError` for a bad calibration file.
    """
    recipes = Recipes(file, control)
    stack.push(recipes.remove_at_end)
    if not config.kind.has_hardware:
        recipes.write_without_servo()
        if file and not (release_recipe.read(str(file)) or {}).get("fresh"):
            release_recipe.remove(str(file))  # of an earlier content of the file
        robot: Robot = open_fish(config).robot()
        return dataclasses.replace(robot, write_recipes=recipes.write_for)
    stack.enter_context(ownership.claim_parts(parts_of(config)))
    recipes.remove_former()
    if config.kind.is_virtual:
        plug_in_virtual_pi(config, stack)
    return assemble(config, clock, stack, threaded=True, recipes=recipes)


def simulated_fish(config: Config) -> SimulatedFish:
    """Return a simulated fish on its rod; it needs no hardware and need not be closed."""
    return SimulatedFish(config.plant, config.simulation, config.tick)


def open_fish(config: Config) -> Any:
    """Return the fish of a robot without drivers, as `RobotKind.open` describes it.

    Raises `MissingPackage`, and `StartupError` where a robot of another package cannot start.
    """
    try:
        fish = call_foreign(config.kind.open, config)
        if fish is not None and not callable(getattr(fish, "robot", None)):
            raise TypeError(f"open returned {text.quoted(repr(fish))}, which has no method robot")
        return fish or simulated_fish(config)
    except FishdError:
        raise
    except Exception as error:
        message = f"robot '{config.robot}' cannot start: {text.describe_error(error)}"
        raise StartupError(message) from error


def parts_of(config: Config) -> tuple[ownership.Part, ...]:
    """Return the parts that no other fishd may drive; `fishctl release` ignores such claims."""
    if not config.kind.has_hardware:
        return ()
    if config.kind.is_virtual:
        return ownership.parts_of_virtual_pi(virtual_pi_socket(config.virtual_pi.socket))
    return ownership.parts_of_pi(claims_of(config.driver_settings))


class InVirtualTime(NamedTuple):
    """Robot whose drivers run in virtual time, with its virtual Pi."""

    robot: Robot
    pi: "VirtualPi"


def open_in_virtual_time(config: Config, stack: ExitStack) -> InVirtualTime:
    """Return a robot with a virtual Pi, whose time advances when the loop reads the sensor.

    The clock of the virtual Pi is ahead of the loop's by the remainder of a conversion.
    """
    from fishd.virtual.pi.gpiochip import EmulatedGpiod
    from fishd.virtual.pi.linux_i2c import LinuxI2c
    from fishd.virtual.pi.virtual_pi import VirtualPi

    clock = VirtualClock()
    clock.now = -config.tick  # so that the first read, at 0, has a window
    settings = replace(config.virtual_pi, pigpio_port=0)  # several virtual Pis may run at once
    pi = VirtualPi(settings, config.plant, config.simulation, config.tick, clock)
    stack.callback(pi.close)
    pi.start()
    set_timeout = partial(setattr, pi.bus, "timeout")
    with driver_packages():
        stack.enter_context(LinuxI2c(pi.bus.transfer, {settings.bus}, set_timeout))
        if config.panel.has_pins:
            stack.enter_context(EmulatedGpiod(pi.pins))
    servo = replace(config.servo, host="127.0.0.1", port=pi.pigpiod.port)
    robot = assemble(
        replace(config, servo=servo),
        clock,
        stack,
        threaded=False,
        truth=pi.tank.truth,
        servo_driver=partial(Pigpio, standstill=pi.pigpiod.stands_still),
    )
    return InVirtualTime(robot, pi)


def open_fish_in_virtual_time(config: Config, stack: ExitStack) -> tuple[Robot, Any]:
    """Return a robot in virtual time, and its fish, as `RobotKind.open` describes it.

    Raises `MissingPackage` if a package is missing.
    """
    if config.kind.is_virtual:
        robot, pi = open_in_virtual_time(config, stack)
        return robot, pi.tank
    fish = open_fish(config)
    return fish.robot(), fish


def plug_in_virtual_pi(config: Config, stack: ExitStack) -> None:
    """Connect the I2C bus and the pins of this process to the virtual Pi that is running.

    Raises `StartupError` if none is running, or a package is missing.
    """
    from fishd.virtual.pi.gpiochip import EmulatedGpiod, Pins
    from fishd.virtual.pi.link import RemotePi
    from fishd.virtual.pi.linux_i2c import LinuxI2c
    from fishd.virtual.pi.wires import Wires

    path = virtual_pi_socket(config.virtual_pi.socket)
    remote = RemotePi(path)
    stack.callback(remote.close)
    buses = {config.virtual_pi.bus}
    with driver_packages():
        stack.enter_context(LinuxI2c(remote.transfer, buses, remote.set_timeout))
        if config.panel.has_pins:
            pins = Pins()
            stack.enter_context(EmulatedGpiod(pins))
            stack.callback(Wires(path, pins.set_level).close)


def state_folder(config: Config) -> Path:
    """Return the folder of the calibrations of this robot."""
    folder = config.state_folder or os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if folder:
        return files.expand_user(folder) / config.robot
    state = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return files.expand_user(state) / "fishd" / config.robot


def end_pulses(config: Config) -> bool:
    """Send neutral and end the pulses, when fishd is dead; return False if there were none.

    Raises `ServoError`, `StartupError` when a package is missing, and `ConfigError` when the
    calibration cannot be read.
    """
    settings = config.servo
    kind = SERVOS.find(settings.driver)
    neutral = pulses.pulse_width(settings.calibrated(_servo_calibration(config)), 0.0)
    with driver_packages(settings.driver):
        if resort := kind.last_resort(settings):
            return release_recipe.carry_out(resort.function, neutral, resort.arguments)
        servo = kind(settings, neutral, SystemClock(), tick=config.tick, threaded=False)
        try:
            servo.off()
        finally:
            servo.close()
    return False


def read_pulses(config: Config) -> bool | None:
    """Read back whether the servo has pulses; return None if its driver does not know.

    Raises `ServoError`, and `StartupError` when a package is missing.
    """
    with driver_packages(config.servo.driver):
        return SERVOS.find(config.servo.driver).read_pulses(config.servo)


def read_calibrations(config: Config) -> None:
    """Read the newest calibrations of this robot; raise `ConfigError` for a bad file."""
    folder = CalibrationFolder(state_folder(config))
    folder.newest(ForceCalibration)
    folder.newest(ServoCalibration)


def _servo_calibration(config: Config) -> ServoCalibration:
    newest = CalibrationFolder(state_folder(config)).newest(ServoCalibration)
    return newest[0] if newest else config.servo.calibration


def assemble(
    config: Config,
    clock: Clock,
    stack: ExitStack,
    *,
    threaded: bool,
    recipes: Recipes | None = None,
    truth: Callable[[], Truth] | None = None,
    servo_driver: Callable[..., ServoDriver[Any]] | None = None,
) -> Robot:
    """Return the robot on the buses and pins of this process; do as `open_robot` without claims.

    threaded: False for a clock in virtual time
    recipes: recipes with which other programs end these pulses; None for none
    servo_driver: function that opens the servo, by default the class that the configuration names
    """
    panel = _open_panel(config, clock, stack)
    folder = CalibrationFolder(state_folder(config))
    for line in folder.ignored():
        log.warning("%s", line)
    sensors = _open_sensors(config, clock, threaded=threaded)
    stack.callback(close_all, sensors)

    def read_others() -> None:
        """Let the other sensors sample between the samples of the force, in virtual time."""
        for other in sensors:
            other.read()

    sensor = open_sensor(config, clock, threaded=threaded, between_samples=read_others)
    stack.callback(sensor.close)
    settings = config.servo
    with driver_packages(settings.driver):
        servo = CalibratedServo(
            servo_driver or SERVOS.find(settings.driver),
            settings,
            _servo_calibration(config),
            clock,
            threaded=threaded,
            tick=config.tick,
        )
    stack.callback(servo.close)  # last in, first out: on any failure, this is done first

    def write_recipes(calibration: ServoCalibration) -> None:
        """Write the recipes with which `fishd-release` can end these pulses quickly."""
        if recipes and (resort := servo.driver.last_resort(settings)):
            recipes.write(resort, servo.driver.neutral)

    write_recipes(servo.calibration)
    if threaded:
        _await_first_sample(sensor.read, clock)

    if permitted := pulses.format_reach(settings, config.amplitude_limit):
        log.info("servo.lowest and servo.highest permit %s, amplitude_limit", permitted)
    if warning := _calibration_warning(config, servo):
        log.warning("%s", warning)

    def limitations() -> tuple[str, ...]:
        lines = (
            *sensor.limitations,
            *(line for other in sensors for line in other.limitations),
            *read_limitations(servo.driver),
        )
        if sensor.calibration.is_unset:
            lines += (
                f"the force is not calibrated, and shown in {sensor.unit}: fishctl calibrate force",
            )
            if config.estimator.kind == "observer":
                lines += (
                    "estimator.kind: observer needs forces in N, so the fin velocity is wrong",
                )
        warning = _calibration_warning(config, servo)
        return (*lines, warning) if warning else lines

    return Robot(
        name=config.robot,
        sensor=sensor,
        servo=servo,
        truth=truth,
        panel=panel,
        tared=sensor,
        calibrated=CalibratedParts(sensor, servo, write_recipes),
        limitations=limitations,
        counters=lambda: {
            **sensor.counters(),
            **read_counters(servo.driver),
            **{name: count for other in sensors for name, count in other.counters().items()},
        },
        sensors=sensors,
        countdown=servo.driver.countdown,
        write_recipes=recipes.write_for if recipes else lambda control: None,
    )


def _do_nothing() -> None:
    pass


def _open_sensors(
    config: Config, clock: Clock, *, threaded: bool, modelled: Container[str] = ()
) -> "tuple[SampledReadings, ...]":
    """Return the configured sensors; they need not answer yet.

    A simulated fish has stand-ins for those that need hardware.

    modelled: readings that the fish has a model of, and that no sensor replaces
    Raises `StartupError` when a package is missing.
    """
    if not config.sensors:
        return ()
    from fishd.hardware.sensors.sampled_readings import SampledReadings, sample_period
    from fishd.hardware.sensors.simulated import StandIn

    sensors = []
    for name, settings in config.sensors.items():
        kind, readings = SENSORS.find(settings.kind), readings_of(settings)
        replaced = [reading for reading in readings if reading in modelled]
        if replaced or not (config.kind.has_hardware or kind.is_simulated):
            kind = StandIn.of(kind, replaced)
            readings = {name: readings[name] for name in readings if name not in replaced}
        with driver_packages(settings.kind):
            period = sample_period(kind, settings, config.tick)
            driver = kind(settings, clock, period, f"sensors.{name}")
        sensors.append(
            SampledReadings(name, driver, readings, clock, threaded=threaded, tick=config.tick)
        )
    return tuple(sensors)


def _with_stand_ins(config: Config, robot: Robot, clock: Clock) -> Robot:
    """Return a simulated fish with the configured sensors, which its ticks sample."""
    modelled = {name for sensor in robot.sensors for name in sensor.declared}
    sensors = _open_sensors(config, clock, threaded=False, modelled=modelled)
    lines = tuple(line for sensor in sensors for line in sensor.limitations)
    return dataclasses.replace(
        robot,
        sensors=(*robot.sensors, *sensors),
        limitations=lambda: (*robot.limitations(), *lines),
    )


def open_sensor(
    config: Config,
    clock: Clock,
    *,
    threaded: bool,
    between_samples: Callable[[], None] = _do_nothing,
) -> SampledSensor:
    """Return the force sensor alone, with the newest saved calibration.

    between_samples: that of `SampledSensor`
    Raises `StartupError` when a package is missing, and `ConfigError` for a damaged calibration.
    """
    settings = config.force_sensor
    newest = CalibrationFolder(state_folder(config)).newest(ForceCalibration)
    calibration = newest[0] if newest else ForceCalibration()
    with driver_packages(settings.driver):
        return SampledSensor(
            FORCE_SENSORS.find(settings.driver)(settings, clock),
            calibration,
            clock,
            threaded=threaded,
            tick=config.tick,
            between_samples=between_samples,
        )


def _calibration_warning(config: Config, servo: CalibratedServo) -> str | None:
    """Return a line if the calibration of the servo does not permit ±Φ; None if it does."""
    permitted = servo.format_reach(config.amplitude_limit)
    if not permitted or servo.calibration == config.servo.calibration:
        return None
    return (
        f"the servo's calibration of {servo.calibration.date or 'no date'} permits {permitted}, "
        "amplitude_limit: fishctl calibrate servo"
    )


def _open_panel(config: Config, clock: Clock, stack: ExitStack) -> "Panel | None":
    if not config.panel.has_pins:
        return None
    from fishd.hardware.panel import Panel

    panel = Panel(config.panel, clock)
    stack.callback(panel.close)
    return panel


def _await_first_sample(read: Callable[[float], object], clock: Clock) -> None:
    """Give the sensor time to start, so that a normal start does not cause a fault."""
    deadline = clock.monotonic() + FIRST_SAMPLE_TIMEOUT_S
    while clock.monotonic() < deadline:
        try:
            read(clock.monotonic())
        except SensorError:
            clock.sleep(0.01)
        else:
            return


def build_estimator(config: Config) -> Estimator:
    """Return the estimator that `estimator.kind` names."""
    if config.estimator.kind == "observer":
        return Observer(config.estimator, config.plant, config.tick)
    if config.estimator.kind in ("sensor", "tail"):
        return FinSensor()
    return LateralForceEstimator(config.estimator)


def build_live_thrust(config: Config) -> LiveThrust:
    """Return the estimate of the thrust and its interval, with nothing known."""
    return LiveThrust(config.estimator.zero_drift)


def build_guard(config: Config) -> Guard:
    """Return a guard with the limits of the configuration."""
    return Guard(config.amplitude_limit, config.tick, config.slew_limit, config.fade_time)


def build_loop(
    config: Config,
    robot: Robot,
    clock: Clock,
    publisher: Publisher | None,
    notify: Callable[[float], None] | None = None,
) -> ControlLoop:
    """Return a loop in which `config.start.controller` is active, if one is set.

    publisher: receiver of the record of every tick and of every event; None to make no records
    notify: function called at the end of every tick with the time of its start [s, monotonic]
    Raises `UnknownController` and `ParameterError`, neither for a configuration from `load`.
    """
    guard = build_guard(config)
    if config.sensors and not config.kind.has_hardware:
        robot = _with_stand_ins(config, robot, clock)
    if robot.calibrated:
        guard.restrict(*robot.calibrated.servo.reach)
    loop = ControlLoop(
        robot=robot,
        estimator=build_estimator(config),
        thrust=build_live_thrust(config),
        lateral_sign=LateralSign(config.estimator.reversed_fy),
        guard=guard,
        settings=config,
        limits=config.limits,
        clock=clock,
        publisher=publisher,
        notify=notify,
    )
    start = config.start
    if created := start.create_controller(config.limits):
        if start.rest:
            loop.set_controller_after(start.rest, *created)
        else:
            loop.set_controller(*created)
    return loop
