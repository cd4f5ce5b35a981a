"""Force sensor of fishd on an emulated ADS1115."""

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
"""Step of the ADC at the default range [V]."""
MUX = {"A0-A1": 0, "A0-A3": 1, "A1-A3": 2, "A2-A3": 3, "A0": 4, "A1": 5, "A2": 6, "A3": 7}


class ForceRig(Board):
    """Board with voltages on two pairs of inputs, and the drivers that read them."""

    def __init__(self, noise: float = 1.0, **options: Any) -> None:
        super().__init__(noise=noise, **options)
        self.volts: dict[str, float | Callable[[float], float]] = {"A0-A1": 0.5, "A2-A3": -0.25}

    def sensor_driver(self, **settings: Any) -> Ads1115:
        """Return a driver."""
        return Ads1115(Ads1115Settings(**settings), self.clock)

    def sampler(self, **settings: Any) -> Sampler[Pair]:
        """Return a sampler without a thread."""
        return Sampler(self.sensor_driver(**settings), self.clock)

    def sensor(
        self, calibration: ForceCalibration | None = None, tick: float = TICK, **settings: Any
    ) -> SampledSensor:
        """Return a sensor whose sampler steps at each read."""
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
        """Return the measurement of the next tick; raises `SensorError` as the sensor does."""
        self.index += 1
        return self.sensor.read(self.index * self.tick)

    def run(self, seconds: float) -> list[Measurement | str]:
        """Return the measurement, or the text of the error, of each of many ticks."""
        reads: list[Measurement | str] = []
        for _ in range(round(seconds / self.tick)):
            try:
                reads.append(self.next())
            except SensorError as error:
                reads.append(str(error))
        return reads


def measurements(reads: list[Measurement | str]) -> list[Measurement]:
    """Return the reads as measurements; none may have failed."""
    assert all(isinstance(item, Measurement) for item in reads), reads
    return [item for item in reads if isinstance(item, Measurement)]


def take_pairs(sampler: Sampler[Pair], rig: ForceRig, seconds: float) -> list[Pair]:
    """Return the pairs that a sampler delivers in the next `seconds`."""
    sampler.samples.clear()
    pairs: list[Pair] = []
    end = rig.clock.now + seconds
    while rig.clock.now < end:
        sampler.step()
        while sampler.samples:
            pairs.append(sampler.samples.popleft())
    return pairs


def volts(pair: Pair) -> tuple[float, float]:
    """Return the voltages of both channels at the default range."""
    return pair.vx, pair.vy
