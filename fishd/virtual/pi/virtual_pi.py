"""A Raspberry Pi with its sensor, servo and fish, put together from the emulated parts."""

import threading
import time
from collections.abc import Mapping
from functools import partial

from msgspec import Struct

from fishd.core.clock import Clock
from fishd.core.errors import StartupError
from fishd.core.signals import Truth
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.ads1115 import Ads1115Chip
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import I2cBus
from fishd.virtual.pi.ina import CHIPS
from fishd.virtual.pi.pigpiod.daemon import Pigpiod
from fishd.virtual.pi.pins import Pins
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.tank import Tank
from fishd.virtual.plant.parameters import PlantParameters

POWER_METER = 0x40
"""Address of the power meter."""
_LONGEST_CONVERSION = 0.2  # of the slowest data rate, and a little more [s]


class PunctualClock:
    """The machine's clock, with sleeps that are right on average, even very short ones.

    It wakes up early by as much as the machine lately woke it up late, tens of microseconds.
    """

    monotonic = staticmethod(time.monotonic)
    wall = staticmethod(time.time)

    def __init__(self) -> None:
        self._lateness = 0.0

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        asked = max(0.0, seconds - self._lateness)
        begun = time.monotonic()
        time.sleep(asked)
        late = min(time.monotonic() - begun - asked, 2e-4)
        self._lateness += 0.05 * (late - self._lateness)


class PiState(Struct, frozen=True):
    """What a virtual Pi is doing."""

    pigpio_port: int
    """TCP port of its pigpiod."""
    pulse: float
    """Servo pulse [µs]; 0 while there are none."""
    angle: float | None
    """What that pulse means [rad]; None while there are none."""
    truth: Truth
    """The true state of the fish at the end of the latest conversion."""
    faults: dict[str, float | None]
    """Active faults, and how long each still lasts [s]; None: until it is cleared."""
    levels: dict[int, int]
    """GPIOs that something outside, such as a button, drives low or high."""


class VirtualPi:
    """Everything on one clock, virtual or real; use it as a context manager."""

    def __init__(
        self,
        settings: VirtualPiSettings,
        plant: PlantParameters,
        imperfections: SimulationSettings,
        tick: float,
        clock: Clock,
    ) -> None:
        """`tick`: period that the noise of `imperfections` refers to [s]."""
        seed = 3 * imperfections.seed  # three sources of chance must not repeat one another
        self.settings = settings
        self.faults = Faults(clock, seed + 1)
        self.bus = I2cBus(clock, settings.bus_speed, self.faults)
        self.pigpiod = Pigpiod(clock, self.faults, settings.pigpio_port)
        self.tank = Tank(
            settings,
            plant,
            imperfections,
            tick,
            partial(self.pigpiod.width, settings.servo_gpio),
            clock.monotonic(),
        )
        self.chip = Ads1115Chip(
            clock, self.tank.volts, self.faults, settings.adc_noise, seed=seed + 2
        )
        self.bus.attach(settings.address, self.chip)
        if settings.power_meter:
            supply = imperfections.motor.voltage
            meter = CHIPS[settings.power_meter]
            self.bus.attach(
                POWER_METER, meter(clock, self.tank.power, self.faults, supply, settings.shunt)
            )
        self.pins = Pins()
        """The header as rpi-lgpio sees it."""
        self._clock = clock
        self._levels: dict[int, int] = {}
        self._rewired = threading.Condition()
        self._started = False

    def start(self) -> None:
        """Let pigpiod listen; raises `StartupError` when it cannot."""
        try:
            self.pigpiod.start()
            self._started = True
        except OSError as error:
            raise StartupError(
                f"virtual_pi.pigpio_port: cannot listen on port {self.settings.pigpio_port}: "
                f"{error.strerror}; stop what uses it, pigpiod perhaps, or choose another port"
            ) from None

    def close(self) -> None:
        """Stop pigpiod; may be called twice."""
        if self._started:
            self.pigpiod.close()

    def __enter__(self) -> "VirtualPi":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive a pin of the header from outside; None lets go of it. ValueError: no such pin."""
        if not 0 <= gpio <= 27:
            raise ValueError(f"GPIO {gpio} is not valid: 0 to 27 is needed")
        with self._rewired:
            self._levels.pop(gpio, None)
            if level is not None:
                self._levels[gpio] = level
            self._rewired.notify_all()
        self.pins.set_level(gpio, level)

    def levels(self, other_than: Mapping[int, int], patience: float) -> dict[int, int]:
        """The pins driven from outside, once they are other than these or patience [s] ends."""
        with self._rewired:
            self._rewired.wait_for(lambda: self._levels != other_than, patience)
            return dict(self._levels)

    def state(self) -> PiState:
        """What it is doing now; the fish swims on where nobody reads the sensor."""
        now = self._clock.monotonic()
        self.tank.catch_up(now - _LONGEST_CONVERSION)
        return PiState(
            pigpio_port=self.pigpiod.port,
            pulse=self.pigpiod.width(self.settings.servo_gpio, now),
            angle=self.tank.angle(now),
            truth=self.tank.truth(),
            faults=self.faults.listing(),
            levels=dict(self._levels),
        )
