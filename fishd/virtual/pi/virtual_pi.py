"""Virtual Raspberry Pi with sensor, servo and fish, composed of the emulated parts."""

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
from fishd.virtual.pi.gpiochip import Pins
from fishd.virtual.pi.i2c import I2cBus
from fishd.virtual.pi.ina import CHIPS
from fishd.virtual.pi.pigpiod.daemon import Pigpiod
from fishd.virtual.pi.rc_filter import RcFilter
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.tank import Tank
from fishd.virtual.plant.parameters import PlantParameters

POWER_METER_ADDRESS = 0x40
"""I2C address of the power meter."""
ADC_BITS = {"ads1115": 16, "ads1015": 12}
"""Number of bits of each ADC."""
_MUX_OF_A0 = (0, 1, 4)
"""Mux bits of the inputs A0-A1, A0-A3 and A0; the other two pins are at ground beside a filter."""
_MAX_CONVERSION_S = 0.2
"""Upper bound of the time of a conversion at the slowest data rate [s]."""


class PunctualClock:
    """Clock of the machine whose sleeps have the right length on average, even very short ones.

    It shortens each sleep by the recent mean delay of the wake-up, tens of microseconds.
    """

    monotonic = staticmethod(time.monotonic)
    wall = staticmethod(time.time)

    def __init__(self) -> None:
        self._lateness = 0.0

    def sleep(self, seconds: float) -> None:
        """Sleep for a time [s]."""
        duration = max(0.0, seconds - self._lateness)
        start_time = time.monotonic()
        time.sleep(duration)
        lateness = min(time.monotonic() - start_time - duration, 2e-4)
        self._lateness += 0.05 * (lateness - self._lateness)


class PiState(Struct, frozen=True):
    """State of a virtual Pi."""

    pigpio_port: int
    """TCP port of its pigpiod."""
    pulse: float
    """Servo pulse [µs]; 0 without pulses."""
    phi_c: float | None
    """Instruction angle of the pulse [rad]; None without pulses."""
    truth: Truth
    """True state of the fish at the end of the latest conversion."""
    faults: dict[str, float | None]
    """Active faults and their remaining times [s]; None: until cleared."""
    levels: dict[int, int]
    """Levels of the GPIOs that are driven from outside, for example by a button."""


class VirtualPi:
    """Virtual Pi on one clock, virtual or real; a context manager."""

    def __init__(
        self,
        settings: VirtualPiSettings,
        plant: PlantParameters,
        imperfections: SimulationSettings,
        tick: float,
        clock: Clock,
    ) -> None:
        """`tick`: period to which the noise of `imperfections` refers [s]."""
        seed = 3 * imperfections.seed  # the three random sequences must differ
        self.settings = settings
        self.faults = Faults(clock, seed + 1)
        self.bus = I2cBus(clock, settings.bus_speed, self.faults)
        self.pigpiod = Pigpiod(clock, self.faults, settings.pigpio_port, settings.pulse_lead)
        pulse = partial(self.pigpiod.width, settings.servo_gpio)
        self.tank = Tank(settings, plant, imperfections, tick, pulse, clock.monotonic())
        self._filter: RcFilter | None = None
        if settings.filter_time is not None:
            edges = partial(self.pigpiod.edges, settings.servo_gpio)
            self._filter = RcFilter(edges, settings.filter_time)
        if settings.loop_gpio is not None:
            self.pigpiod.connect(settings.loop_gpio, settings.servo_gpio)
        is_plain = self._filter is None and settings.adc_gain == 1.0
        volts = self.tank.volts if is_plain else self._volts
        self.chip = Ads1115Chip(
            clock, volts, self.faults, settings.adc_noise, seed + 2, ADC_BITS[settings.adc]
        )
        self.bus.attach(settings.address, self.chip)
        if settings.power_meter:
            supply = imperfections.motor.voltage
            meter = CHIPS[settings.power_meter]
            self.bus.attach(
                POWER_METER_ADDRESS,
                meter(clock, self.tank.power, self.faults, supply, settings.shunt),
            )
        self.pins = Pins()
        """Pins of the header, as used by gpiod."""
        self._clock = clock
        self._levels: dict[int, int] = {}
        self._levels_changed = threading.Condition()
        self._started = False

    def start(self) -> None:
        """Start pigpiod; raises `StartupError` when it cannot listen."""
        try:
            self.pigpiod.start()
            self._started = True
        except OSError as error:
            raise StartupError(
                f"virtual_pi.pigpio_port: cannot listen on port {self.settings.pigpio_port}: "
                f"{error.strerror}; stop the program that uses it, "
                "perhaps pigpiod, or choose another port"
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

    def _volts(self, mux: int, begin: float, end: float) -> float:
        """Do as `Tank.volts`, with the filter at A0, if any, and the gain of the ADC."""
        if self._filter and mux in _MUX_OF_A0:
            volts = self._filter.mean(begin, end)
        else:
            volts = self.tank.volts(mux, begin, end)
        return self.settings.adc_gain * volts

    def set_level(self, gpio: int, level: int | None) -> None:
        """Drive a pin of the header from outside, None: stop; raises ValueError for another pin."""
        if not 0 <= gpio <= 27:
            raise ValueError(f"GPIO {gpio} is not valid: 0 to 27 is needed")
        with self._levels_changed:
            self._levels.pop(gpio, None)
            if level is not None:
                self._levels[gpio] = level
            self._levels_changed.notify_all()
        self.pins.set_level(gpio, level)

    def levels(self, other_than: Mapping[int, int], patience: float) -> dict[int, int]:
        """Return the pins driven from outside when they differ, or after `patience` [s]."""
        with self._levels_changed:
            self._levels_changed.wait_for(lambda: self._levels != other_than, patience)
            return dict(self._levels)

    def state(self) -> PiState:
        """Return the current state; this advances the fish even if the sensor is not read."""
        now = self._clock.monotonic()
        self.tank.catch_up(now - _MAX_CONVERSION_S)
        return PiState(
            pigpio_port=self.pigpiod.port,
            pulse=self.pigpiod.width(self.settings.servo_gpio, now),
            phi_c=self.tank.instruction_angle(now),
            truth=self.tank.truth(),
            faults=self.faults.listing(),
            levels=dict(self._levels),
        )
