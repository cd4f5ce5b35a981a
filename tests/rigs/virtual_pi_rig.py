"""A virtual Pi in virtual time, with the true driver of its ADS1115 and the true pigpio client."""

import math
from typing import Any, Self

from adafruit_ads1x15 import ADS1115, AnalogIn
from adafruit_extended_bus import ExtendedI2C

from fishd.core.clock import VirtualClock
from fishd.hardware.servo.pigpio_client import Client
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.linux_i2c import LinuxI2c
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.plant.parameters import PlantParameters

TICK = 0.05
BUS = 203
"""A bus that no machine has."""
GPIO = 18
PATIENCE = 20.0


class VirtualPiRig:
    """A context manager, while which /dev/i2c-203 exists in this process."""

    def __init__(self, simulation: dict[str, Any] | None = None, **settings: Any) -> None:
        self.clock = VirtualClock()
        self.pi = VirtualPi(
            VirtualPiSettings(bus=BUS, pigpio_port=0, **settings),
            PlantParameters(),
            SimulationSettings(**{"noise": 0.0, **(simulation or {})}),
            TICK,
            self.clock,
        )
        self.device = LinuxI2c(self.pi.bus.transfer, {BUS}, self._set_timeout)

    def __enter__(self) -> Self:
        self.pi.start()
        self.device.install()
        self.pigpio = Client("127.0.0.1", self.pi.pigpiod.port, PATIENCE)
        self.ads = ADS1115(ExtendedI2C(BUS, frequency=None), data_rate=860, gain=8)
        self.x, self.y = AnalogIn(self.ads, 0, 1), AnalogIn(self.ads, 2, 3)
        return self

    def __exit__(self, *_: object) -> None:
        self.pigpio.close()
        self.device.remove()
        self.pi.close()

    def steer(self, angle: float) -> None:
        self.pigpio.within(PATIENCE)
        self.pigpio.set_servo_pulsewidth(GPIO, 1500 + 600 * angle)

    def forces_until(self, time: float) -> tuple[float, float]:
        """Mean voltages at x and y from now to a time [s]."""
        xs, ys = [], []
        while self.clock.now < time:
            xs.append(self.x.voltage)
            ys.append(self.y.voltage)
        return math.fsum(xs) / len(xs), math.fsum(ys) / len(ys)

    def _set_timeout(self, seconds: float) -> None:
        self.pi.bus.timeout = seconds
