"""Installed example packages of docs/, and fish with them in virtual time."""

import os
import subprocess
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from fishd.assembly import assemble
from fishd.controllers import registry
from fishd.core import robots
from fishd.core.clock import VirtualClock
from fishd.hardware.base import Robot
from fishd.hardware.registry import FORCE_SENSORS, SENSORS, SERVOS
from fishd.hardware.servo.pigpio import Pigpio
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.ads1115 import Ads1115Chip
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import I2cBus
from fishd.virtual.pi.linux_i2c import LinuxI2c
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.tank import Tank
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.plant.registry import PLANTS
from rigs.documents import ROOT
from rigs.hx711_chip import GpioStandIn, Hx711Chip
from rigs.lockstep_rig import LockstepRig
from rigs.pca9685_chip import Pca9685Chip
from rigs.processes import FISHCTL
from rigs.sensor_chips import KellerChip

MILLIVOLTS_PER_NEWTON = 20.0
BUS = 204
"""Bus that does not exist on any machine."""


def install(folder: Path, examples: str) -> None:
    """Build the packages in docs/`examples` as in their documentation, without the network."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-cache-dir", "--no-index"]
    packages = [str(path.parent) for path in (ROOT / "docs" / examples).rglob("pyproject.toml")]
    offline = ["--no-build-isolation", "--no-deps", "--target", str(folder)]
    subprocess.run([*pip, *offline, *packages], check=True)


def fishctl(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run fishctl with the installed packages of a folder, without a daemon."""
    mine = {"PYTHONPATH": str(site), "XDG_RUNTIME_DIR": str(site), "COLUMNS": "100"}
    command = [FISHCTL, *arguments]
    options = {"capture_output": True, "text": True, "check": False}
    return subprocess.run(command, env=os.environ | mine, **options)


def forget_drivers() -> None:
    """Reload the drivers, plants, robots and controllers of other packages."""
    for plugins in (FORCE_SENSORS, SERVOS, SENSORS, PLANTS, robots.registry(), registry._plugins):
        plugins._found.clear()
        vars(plugins).pop("_offered", None)


class LoadCellRig(LockstepRig):
    """Fish on two load cells, with its servo on pigpiod."""

    robot_name = "pi"

    def open_robot(self, stack: ExitStack) -> Robot:
        config, clock = self.config, VirtualClock()
        clock.now = -config.tick
        settings = VirtualPiSettings(pigpio_port=0)
        self.pi = VirtualPi(settings, config.plant, SimulationSettings(), config.tick, clock)
        stack.enter_context(self.pi)
        millivolt = 1e-3 * MILLIVOLTS_PER_NEWTON

        def volts(mux: int, begin: float, end: float) -> float:
            return millivolt * self.pi.tank.volts(mux, begin, end)

        chips = {6: Hx711Chip(clock, partial(volts, 0)), 13: Hx711Chip(clock, partial(volts, 3))}
        self.gpio = stack.enter_context(GpioStandIn(clock, 5, chips))
        still = self.pi.pigpiod.stands_still
        return _robot(config, clock, stack, self.pi.pigpiod.port, partial(Pigpio, standstill=still))


class DepthRig(LockstepRig):
    """Fish on a virtual Pi with a Keller LD on the bus of its force sensor."""

    robot_name = "pi"

    def open_robot(self, stack: ExitStack) -> Robot:
        config, clock = self.config, VirtualClock()
        clock.now = -config.tick
        settings = VirtualPiSettings(pigpio_port=0, power_meter=None)
        self.pi = VirtualPi(settings, config.plant, SimulationSettings(), config.tick, clock)
        self.keller = KellerChip(clock)
        self.pi.bus.attach(0x40, self.keller)
        stack.enter_context(self.pi)
        set_timeout = partial(setattr, self.pi.bus, "timeout")
        stack.enter_context(LinuxI2c(self.pi.bus.transfer, {settings.bus}, set_timeout))
        still = self.pi.pigpiod.stands_still
        return _robot(config, clock, stack, self.pi.pigpiod.port, partial(Pigpio, standstill=still))


class ServoBoardRig(LockstepRig):
    """Fish whose servo is on a PCA9685, on one bus with the ADS1115."""

    robot_name = "pi"

    def open_robot(self, stack: ExitStack) -> Robot:
        config, clock = self.config, VirtualClock()
        clock.now = -config.tick
        faults = Faults(clock)
        bus = I2cBus(clock, 400e3, faults)
        self.board = Pca9685Chip(clock)
        settings, plant = VirtualPiSettings(), config.plant
        pulse = self.board.width
        self.tank = Tank(settings, plant, SimulationSettings(), config.tick, pulse, clock.now)
        bus.attach(0x40, self.board)
        bus.attach(0x48, Ads1115Chip(clock, self.tank.volts, faults))
        stack.enter_context(LinuxI2c(bus.transfer, {BUS}, partial(setattr, bus, "timeout")))
        return assemble(config, clock, stack, threaded=False, truth=self.tank.truth)


def _robot(config: Any, clock: VirtualClock, stack: ExitStack, port: int, servo: Any) -> Robot:
    from msgspec.structs import replace

    config = replace(config, servo=replace(config.servo, port=port))
    return assemble(config, clock, stack, threaded=False, servo_driver=servo)
