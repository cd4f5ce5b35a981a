"""Fishd's force sensor on an emulated ADS1115."""

from collections.abc import Callable
from typing import Any

from fishd.core.calibration import ForceCalibration
from fishd.core.errors import SensorError
from fishd.core.signals import Measurement
from fishd.hardware.driver import Pair
from fishd.hardware.force_sensor.ads1115 import Ads1115, Ads1115Settings
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor
from fishd.hardware.sampler import Sampler
from rigs.ads1115_board import Board

TICK = 0.05
STEP = 2.048 / 32768
"""Of the ADC at the default range [V]."""
MUX = {"A0-A1": 0, "A0-A3": 1, "A1-A3": 2, "A2-A3": 3, "A0": 4, "A1": 5, "A2": 6, "A3": 7}


class ForceRig(Board):
    """A board with voltages on two pairs of inputs, and what reads them."""

    def __init__(self, noise: float = 1.0, **options: Any) -> None:
        super().__init__(noise=noise, **options)
        self.volts: dict[str, float | Callable[[float], float]] = {"A0-A1": 0.5, "A2-A3": -0.25}

    def sensor_driver(self, **settings: Any) -> Ads1115:
        """A driver that somebody else calls."""
        return Ads1115(Ads1115Settings(**settings), self.clock)

    def sampler(self, **settings: Any) -> Sampler[Pair]:
        """A sampler that somebody else steps."""
        return Sampler(self.sensor_driver(**settings), self.clock)

    def sensor(
        self, calibration: ForceCalibration | None = None, tick: float = TICK, **settings: Any
    ) -> SampledSensor:
        """A sensor that reads step."""
        return SampledSensor(
            self.sensor_driver(**settings),
            calibration or ForceCalibration(),
            self.clock,
            threaded=False,
            tick=tick,
        )

    def input(self, mux: int, start: float, end: float) -> float:
        for channel, volts in self.volts.items():
            if MUX[channel] == mux:
                return volts((start + end) / 2) if callable(volts) else volts
        raise AssertionError(f"nothing is wired to multiplexer {mux}")


class Ticks:
    """Reads of a sensor, one per tick."""

    def __init__(self, sensor: SampledSensor, tick: float = TICK) -> None:
        self.sensor = sensor
        self.tick = tick
        self.index = 0

    def next(self) -> Measurement:
        """The measurement of the next tick; raises `SensorError` as it does."""
        self.index += 1
        return self.sensor.read(self.index * self.tick)

    def run(self, seconds: float) -> list[Measurement | str]:
        """What each of many ticks gets: a measurement, or the text of the error."""
        found: list[Measurement | str] = []
        for _ in range(round(seconds / self.tick)):
            try:
                found.append(self.next())
            except SensorError as error:
                found.append(str(error))
        return found


def measurements(found: list[Measurement | str]) -> list[Measurement]:
    """The same, where no read failed."""
    assert all(isinstance(item, Measurement) for item in found), found
    return [item for item in found if isinstance(item, Measurement)]


def take_pairs(sampler: Sampler[Pair], rig: ForceRig, seconds: float) -> list[Pair]:
    """What a sampler delivers in so long a time from now on."""
    sampler.samples.clear()
    found: list[Pair] = []
    end = rig.clock.now + seconds
    while rig.clock.now < end:
        sampler.step()
        while sampler.samples:
            found.append(sampler.samples.popleft())
    return found


def volts(pair: Pair) -> tuple[float, float]:
    """Of both channels at the default range."""
    return pair.vx, pair.vy
