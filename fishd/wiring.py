"""Opens the robot that the configuration describes: its sensor, servo and panel, ready to use."""

import logging
import os
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from msgspec.structs import replace

from fishd import recipe
from fishd.addresses import virtual_pi_socket
from fishd.clock import Clock, VirtualClock
from fishd.config import Config
from fishd.errors import SensorError
from fishd.hardware import ownership, pulses
from fishd.hardware.base import Bench, CalibratedServo, Panel, Robot
from fishd.hardware.calibration import (
    ForceCalibration,
    ServoCalibration,
    as_configured,
    calibrated,
)
from fishd.hardware.calibration_files import CalibrationFolder
from fishd.hardware.packages import driver_packages
from fishd.hardware.simulated import SimulatedFish
from fishd.signals import Truth

if TYPE_CHECKING:  # drivers and emulation are loaded where they are used: most runs need neither
    from fishd.emulation.virtual_pi import VirtualPi

log = logging.getLogger(__name__)

START_LIMIT = 1.0
"""How long the force sensor may take for its first sample [s]."""


def open_robot(config: Config, clock: Clock, stack: ExitStack, file: Path | None = None) -> Robot:
    """The robot, in real time; leaving `stack` releases its servo first, then lets go of the rest.

    file: the configuration file, by which `fishd-release` will ask for this servo
    A sensor or servo that does not answer is no error here: the loop will say so, and recovers
    when it comes back. Raises `StartupError` when a package is missing, no virtual Pi is running or
    another fishd drives this robot, `ConfigError` when a calibration file is broken.
    """
    if config.robot == "simulated":
        if file and not (recipe.read(str(file)) or {}).get("fresh"):
            recipe.remove(str(file))  # of what the file said before
        return SimulatedFish(config.plant, config.simulation, config.tick).robot()
    stack.enter_context(ownership.owned(parts_of(config)))
    if file:
        recipe.remove(str(file))  # of an earlier fishd
    if config.robot == "virtual-pi":
        plug_in_virtual_pi(config, stack)
    return _assemble(config, clock, stack, threaded=True, file=file)


def parts_of(config: Config) -> tuple[ownership.Part, ...]:
    """What no other fishd may drive meanwhile; `fishctl release`, the last resort, does not ask."""
    if config.robot == "pi":
        return ownership.parts_of_pi(config.force_sensor, config.servo)
    if config.robot == "virtual-pi":
        return ownership.parts_of_virtual_pi(virtual_pi_socket(config.virtual_pi.socket))
    return ()


class InVirtualTime(NamedTuple):
    """A robot whose whole hardware path runs in virtual time, and the virtual Pi behind it."""

    robot: Robot
    pi: "VirtualPi"


def open_in_virtual_time(config: Config, stack: ExitStack) -> InVirtualTime:
    """A virtual Pi and the drivers on it in virtual time: it moves when the loop reads the sensor.

    Its own clock runs ahead of the loop's by the rest of a conversion.
    """
    from fishd.emulation.lgpio import EmulatedLgpio
    from fishd.emulation.linux_i2c import LinuxI2c
    from fishd.emulation.virtual_pi import VirtualPi

    clock = VirtualClock()
    clock.now = -config.tick  # so that the first read, at 0, finds a window
    settings = replace(config.virtual_pi, pigpio_port=0)  # several may run at once
    pi = VirtualPi(settings, config.plant, config.simulation, config.tick, clock)
    stack.callback(pi.close)
    pi.start()
    set_timeout = partial(setattr, pi.bus, "timeout")
    with driver_packages():
        stack.enter_context(LinuxI2c(pi.bus.transfer, {settings.bus}, set_timeout))
    if _has_panel(config):
        stack.enter_context(EmulatedLgpio(pi.pins))
    robot = _assemble(
        with_pigpio_port(config, pi.pigpiod.port), clock, stack, threaded=False, truth=pi.tank.truth
    )
    return InVirtualTime(robot, pi)


def plug_in_virtual_pi(config: Config, stack: ExitStack) -> None:
    """Let the I2C bus and the pins of this process be those of the virtual Pi that is running.

    Raises `StartupError` where there is none, or a package is missing.
    """
    from fishd.emulation.lgpio import EmulatedLgpio
    from fishd.emulation.link import RemotePi
    from fishd.emulation.linux_i2c import LinuxI2c
    from fishd.emulation.pins import Pins
    from fishd.emulation.wires import Wires

    path = virtual_pi_socket(config.virtual_pi.socket)
    remote = RemotePi(path)
    stack.callback(remote.close)
    buses = {config.virtual_pi.bus}
    with driver_packages():
        stack.enter_context(LinuxI2c(remote.transfer, buses, remote.set_timeout))
    if _has_panel(config):
        pins = Pins()
        stack.enter_context(EmulatedLgpio(pins))
        stack.callback(Wires(path, pins.set_level).close)


def state_folder(config: Config) -> Path:
    """Where the calibrations of this robot are kept."""
    folder = config.state_folder or os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if folder:
        return Path(folder).expanduser() / config.robot
    state = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(state).expanduser() / "fishd" / config.robot


def open_servo(config: Config, clock: Clock, *, threaded: bool) -> CalibratedServo:
    """The servo alone; raises `StartupError` when its package is missing."""
    found = CalibrationFolder(state_folder(config)).newest(ServoCalibration)
    calibration = found[0] if found else as_configured(config.servo)
    settings = config.servo
    if settings.driver == "pigpio":
        with driver_packages():
            from fishd.hardware.pigpio import PigpioServo

        return PigpioServo(settings, calibration, clock, threaded=threaded, tick=config.tick)
    if settings.driver == "sysfs-pwm":
        from fishd.hardware.sysfs_pwm import SysfsPwmServo

        return SysfsPwmServo(settings, calibration, clock)
    from fishd.hardware.rpi_gpio import RpiGpioServo

    return RpiGpioServo(settings, calibration, clock)


def _assemble(
    config: Config,
    clock: Clock,
    stack: ExitStack,
    *,
    threaded: bool,
    file: Path | None = None,
    truth: Callable[[], Truth] | None = None,
) -> Robot:
    from fishd.hardware.ads1115 import Ads1115Sensor

    panel = _open_panel(config, clock, stack)
    folder = CalibrationFolder(state_folder(config))
    found = folder.newest(ForceCalibration)
    for line in folder.ignored():
        log.warning("%s", line)
    sensor = Ads1115Sensor(
        config.force_sensor,
        found[0] if found else ForceCalibration(),
        clock,
        threaded=threaded,
        tick=config.tick,
    )
    stack.callback(sensor.close)
    servo = open_servo(config, clock, threaded=threaded)
    stack.callback(servo.close)  # last in, first out: whatever fails, this is done first
    tell_release = partial(_tell_release, config, file)
    tell_release(servo.calibration)
    if threaded:
        _await_first_sample(sensor.read, clock)

    if left := pulses.cut(config.servo, config.amplitude_limit):
        log.info("servo.lowest and servo.highest permit %s, amplitude_limit", left)
    if line := _cut_by_calibration(config, servo.calibration):
        log.warning("%s", line)

    def degraded() -> tuple[str, ...]:
        lines = servo.degraded
        if sensor.calibration.untouched:
            lines += ("the force is not calibrated: fishctl calibrate force",)
        cut = _cut_by_calibration(config, servo.calibration)
        return (*lines, cut) if cut else lines

    return Robot(
        name=config.robot,
        sensor=sensor,
        servo=servo,
        truth=truth,
        panel=panel,
        bench=Bench(sensor, servo, tell_release),
        degraded=degraded,
        counters=lambda: {**sensor.counters(), **servo.counters()},
        countdown=servo.countdown,
    )


def _tell_release(config: Config, file: Path | None, calibration: ServoCalibration) -> None:
    """Leave what `fishd-release` needs to end these pulses quickly, whatever becomes of fishd."""
    if file is None or config.servo.driver == "rpi-gpio":  # whose pulses end with fishd
        return
    servo = calibrated(config.servo, calibration)
    where = {"host": servo.pigpio.host, "port": servo.pigpio.port}
    sysfs = servo.sysfs
    where |= {"root": sysfs.root, "chip": sysfs.chip, "channel": sysfs.channel}
    neutral = pulses.pulse_width(servo, 0.0)
    what = {"driver": servo.driver, "gpio": servo.gpio, "frequency": servo.frequency}
    recipe.write(str(file), {**what, **where, "neutral": neutral})


def _cut_by_calibration(config: Config, calibration: ServoCalibration) -> str:
    """A line about a calibration of the servo with which it cannot go to ±Φ; empty if it can."""
    left = pulses.cut(calibrated(config.servo, calibration), config.amplitude_limit)
    if not left or calibration == as_configured(config.servo):
        return ""
    return (
        f"the servo's calibration of {calibration.date or 'no date'} permits {left}, "
        "amplitude_limit: fishctl calibrate servo"
    )


def _open_panel(config: Config, clock: Clock, stack: ExitStack) -> Panel | None:
    if not _has_panel(config):
        return None
    from fishd.hardware.panel import RpiGpioPanel

    panel = RpiGpioPanel(config.panel, clock)
    stack.callback(panel.close)
    return panel


def _has_panel(config: Config) -> bool:
    return config.panel.estop_gpio is not None or config.panel.led_gpio is not None


def _await_first_sample(read: Callable[[float], object], clock: Clock) -> None:
    """Give the sensor the time that it needs to begin, so that a healthy start is no fault."""
    deadline = clock.monotonic() + START_LIMIT
    while clock.monotonic() < deadline:
        try:
            read(clock.monotonic())
        except SensorError:
            clock.sleep(0.01)
        else:
            return


def with_pigpio_port(config: Config, port: int) -> Config:
    """The configuration with the TCP port of pigpiod that was really taken."""
    pigpio = replace(config.servo.pigpio, host="127.0.0.1", port=port)
    return replace(config, servo=replace(config.servo, pigpio=pigpio))
