"""An emulated ADS1115 behind an emulated /dev/i2c-N in virtual time, and fishd's sensor on it."""

from collections.abc import Callable
from typing import Any

from fishd.clock import VirtualClock
from fishd.emulation.ads1115 import Ads1115Chip
from fishd.emulation.faults import Faults
from fishd.emulation.i2c import I2cBus
from fishd.emulation.linux_i2c import LinuxI2c
from fishd.errors import SensorError
from fishd.hardware.ads1115 import Ads1115Sensor
from fishd.hardware.calibration import ForceCalibration
from fishd.hardware.sampler import Sampler
from fishd.hardware.settings import ForceSensorSettings
from fishd.signals import Measurement

TICK = 0.05
MUX = {"A0-A1": 0, "A0-A3": 1, "A1-A3": 2, "A2-A3": 3, "A0": 4, "A1": 5, "A2": 6, "A3": 7}


class ForceRig:
    """Bus 1 with a chip at 0x48; a context manager, while which its device file exists."""

    def __init__(self, noise: float = 1.0, speed: float = 400e3, seed: int = 0) -> None:
        self.clock = VirtualClock()
        self.faults = Faults(self.clock, seed)
        self.bus = I2cBus(self.clock, speed, self.faults)
        self.volts: dict[str, float | Callable[[float], float]] = {"A0-A1": 0.5, "A2-A3": -0.25}
        self.chip = Ads1115Chip(self.clock, self._volts, self.faults, noise=noise, seed=seed)
        self.bus.attach(0x48, self.chip)
        self.device = LinuxI2c(self.bus.transfer, {1}, self._set_timeout)

    def __enter__(self) -> "ForceRig":
        self.device.install()
        return self

    def __exit__(self, *_: object) -> None:
        self.device.remove()

    def sampler(self, **settings: Any) -> Sampler:
        """A sampler that somebody else steps."""
        return Sampler(ForceSensorSettings(**settings), self.clock)

    def sensor(
        self, calibration: ForceCalibration | None = None, **settings: Any
    ) -> Ads1115Sensor:
        """A sensor that reads step."""
        return Ads1115Sensor(
            ForceSensorSettings(**settings),
            calibration or ForceCalibration(),
            self.clock,
            threaded=False,
            tick=TICK,
        )

    def _volts(self, mux: int, start: float, end: float) -> float:
        for channel, volts in self.volts.items():
            if MUX[channel] == mux:
                return volts((start + end) / 2) if callable(volts) else volts
        raise AssertionError(f"nothing is wired to multiplexer {mux}")

    def _set_timeout(self, seconds: float) -> None:
        self.bus.timeout = seconds


class Ticks:
    """Reads of a sensor, one per tick."""

    def __init__(self, sensor: Ads1115Sensor) -> None:
        self.sensor = sensor
        self.index = 0

    def next(self) -> Measurement:
        """The measurement of the next tick; raises `SensorError` as it does."""
        self.index += 1
        return self.sensor.read(self.index * TICK)

    def run(self, seconds: float) -> list[Measurement | str]:
        """What each of many ticks gets: a measurement, or the text of the error."""
        found: list[Measurement | str] = []
        for _ in range(round(seconds / TICK)):
            try:
                found.append(self.next())
            except SensorError as error:
                found.append(str(error))
        return found
