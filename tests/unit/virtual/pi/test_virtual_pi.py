"""Pulses to forces to volts and back, with the true drivers on the virtual Pi."""

import errno
import math
from typing import Any, Self

import pytest
from adafruit_ads1x15 import ADS1115, AnalogIn
from adafruit_extended_bus import ExtendedI2C
from rigs.processes import PATIENCE

from fishd.core.clock import VirtualClock
from fishd.hardware.servo.pigpio_client import Client
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.lgpio import EmulatedLgpio
from fishd.virtual.pi.linux_i2c import LinuxI2c
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

TICK = 0.05
BUS = 203
"""A bus that no machine has."""
GPIO = 18
AMPLITUDE = 0.4  # 240 µs, a whole number of pigpiod's steps


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


def test_faults_reach_both_halves_of_the_pi() -> None:
    with VirtualPiRig() as rig:
        rig.steer(AMPLITUDE)
        rig.forces_until(0.11)  # between two pulses
        rig.pi.faults.inject("unplugged", 1.0)
        with pytest.raises(OSError, match="Remote I/O") as caught:
            rig.x.voltage  # noqa: B018
        assert caught.value.errno == errno.EREMOTEIO
        rig.pi.faults.inject("pigpiod-gone")
        assert set(rig.pi.state().faults) == {"unplugged", "pigpiod-gone"}
        assert rig.pi.state().faults["pigpiod-gone"] is None
        rig.clock.now += 1.0
        wheel = TetheredFish(PlantParameters())
        wheel.advance(AMPLITUDE, 0.09, 1)
        assert rig.pi.state().pulse == 0.0
        assert rig.pi.state().angle is None
        rig.forces_until(1.5)  # the chip is back, and the wheel has stopped soon after 0.1
        assert rig.pi.tank.truth().phi == pytest.approx(wheel.state.phi, abs=0.05)
        assert abs(rig.pi.tank.truth().phi) < AMPLITUDE - 0.02


def test_the_fish_swims_on_where_nobody_reads_the_sensor() -> None:
    with VirtualPiRig() as rig:
        rig.steer(AMPLITUDE)
        assert rig.pi.state().truth.alpha == 0.0
        rig.clock.now += 10.0
        state = rig.pi.state()
        assert (state.pulse, state.angle) == (1740.0, pytest.approx(AMPLITUDE))
        assert state.truth.phi == pytest.approx(AMPLITUDE)
        assert state.truth.alpha == pytest.approx(PlantParameters().coupling * AMPLITUDE)


def test_a_button_is_seen_by_the_true_gpio_library() -> None:
    with VirtualPiRig() as rig, EmulatedLgpio(rig.pi.pins):
        from RPi import GPIO as gpio  # noqa: N811

        gpio.setmode(gpio.BCM)
        gpio.setup(17, gpio.IN, pull_up_down=gpio.PUD_UP)
        assert gpio.input(17) == 1
        rig.pi.set_level(17, 0)
        assert gpio.input(17) == 0
        assert rig.pi.state().levels == {17: 0}
        rig.pi.set_level(17, None)
        assert gpio.input(17) == 1
        gpio.cleanup()
    with pytest.raises(ValueError, match="GPIO 40 is not valid: 0 to 27 is needed"):
        rig.pi.set_level(40, 1)
