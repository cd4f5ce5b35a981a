"""Errors of a real rig's force measurement: settings, and their simulation over time.

A real sensor is rotated relative to the fish, has an offset that drifts slowly, and is noisy. Its
electronics add mains hum, occasional outliers, and the steps of an ADC.
"""

import math
import random
from typing import Annotated

from msgspec import Meta, Struct

from fishd.core.schema import note, unit
from fishd.virtual.plant.parameters import MotorSettings


class SimulationSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the simulated rig's errors and of its servo's motor."""

    noise: Annotated[
        float, unit("N", "RMS noise of each force, averaged over one tick.", ge=0, le=1, usual=0.1)
    ] = 1e-3
    noise_freedom: Annotated[
        Annotated[float, Meta(ge=2.1, le=1000)] | None,
        unit(
            "1",
            "Degrees of freedom of Student's t-distribution of the noise, with the same rms; fewer "
            "degrees give more outliers. null: Gaussian noise.",
        ),
    ] = None
    hum: Annotated[
        float,
        unit(
            "N",
            "Amplitude of the mains hum on each force; its phases depend on the seed.",
            ge=0,
            le=10,
            usual=0.5,
        ),
    ] = 0.0
    hum_frequency: Annotated[float, unit("Hz", "Frequency of the hum.", ge=0.1, le=1000)] = 50.0
    spike_rate: Annotated[
        float,
        unit(
            "1/s",
            "Rate of spikes on each force, which are single outliers at random times.",
            ge=0,
            le=1000,
        ),
    ] = 0.0
    spike_size: Annotated[
        float,
        unit(
            "N",
            "Size of a spike in either direction; a window is the mean of all its samples.",
            ge=0,
            le=100,
            usual=10,
        ),
    ] = 0.1
    quantum: Annotated[
        Annotated[float, Meta(ge=1e-9, le=1)] | None,
        unit("N", "Resolution of the mean force of a window; null: unlimited."),
    ] = None
    offset_x: Annotated[float, unit("N", "Constant offset on F_x.", ge=-10, le=10, usual=1)] = 0.0
    offset_y: Annotated[float, unit("N", "Constant offset on F_y.", ge=-10, le=10, usual=1)] = 0.0
    drift: Annotated[
        float,
        unit(
            "N",
            "Amplitude of a slow sinusoidal drift of both offsets; its phase depends on the seed.",
            ge=0,
            le=10,
            usual=1,
        ),
    ] = 0.0
    drift_period: Annotated[float, unit("s", "Period of the sinusoidal drift.", gt=0, le=1e6)] = (
        60.0
    )
    drift_rate: Annotated[
        float, unit("N/s", "Rate of an additional linear drift of both offsets.", ge=-1, le=1)
    ] = 0.0
    drift_walk: Annotated[
        float,
        unit(
            "N/√s",
            "Standard deviation after one second of an additional random walk of each offset.",
            ge=0,
            le=1,
        ),
    ] = 0.0
    rotation: Annotated[
        float,
        unit("rad", "Rotation of the sensor's axes relative to the fish.", ge=-math.pi, le=math.pi),
    ] = 0.0
    sample_rate: Annotated[
        float,
        unit(
            "1/s",
            "Pairs of samples per second; a window is the mean of its samples, at least one.",
            ge=1,
            le=10_000,
        ),
    ] = 200.0
    seed: Annotated[
        int, note("Seed of the random numbers for noise, drift, hum and spikes.", ge=0)
    ] = 0
    motor: Annotated[
        MotorSettings, note("The motor of the servo, from which its power is computed.")
    ] = MotorSettings()

    @property
    def is_random(self) -> bool:
        """Whether forces depend on the seed."""
        return any((self.noise, self.hum, self.spike_rate, self.drift, self.drift_walk))


class Imperfections:
    """Conversion of true forces to measured ones."""

    def __init__(self, settings: SimulationSettings, tick: float) -> None:
        """`tick`: period to which `settings.noise` refers [s]."""
        self._settings = settings
        self._tick = tick
        self._random = random.Random(settings.seed)
        self._phase_x = self._random.uniform(0, math.tau)
        self._phase_y = self._random.uniform(0, math.tau)
        self._cos = math.cos(settings.rotation)
        self._sin = math.sin(settings.rotation)
        self._walk_x = self._walk_y = 0.0
        self._duration = self._deviation = 0.0
        """Length of the latest window [s], and the standard deviation of its noise [N]."""
        self._drifts = bool(settings.drift or settings.drift_rate or settings.drift_walk)
        disturbed = settings.hum or settings.spike_rate or settings.quantum
        self._electronics = [Electronics(settings, axis) for axis in "xy"] if disturbed else None

    def apply(
        self, fx: float, fy: float, time: float, duration: float, samples: int = 0
    ) -> tuple[float, float]:
        """Return the measured forces [N] of a window of `duration` that ends at `time` [s].

        time: time since the start, so that a seed gives the same drift in every run
        samples: number of equally spaced samples in the window; 0 for one conversion that lasts
            the whole window
        The noise is white: it decreases with the square root of the window's length.
        """
        settings = self._settings
        if duration != self._duration:
            self._duration = duration
            self._deviation = settings.noise * math.sqrt(self._tick / duration)
        measured_x = self._cos * fx - self._sin * fy + settings.offset_x
        measured_y = self._sin * fx + self._cos * fy + settings.offset_y
        if self._drifts:
            drift_x, drift_y = self._drift(time, duration)
            measured_x += drift_x
            measured_y += drift_y
        x, y = self._normal_pair() if settings.noise_freedom is None else self._student_pair()
        measured_x += self._deviation * x
        measured_y += self._deviation * y
        if self._electronics:
            electronics_x, electronics_y = self._electronics
            measured_x = electronics_x.read(measured_x, time, duration, samples)
            measured_y = electronics_y.read(measured_y, time, duration, samples)
        return measured_x, measured_y

    def _drift(self, time: float, duration: float) -> tuple[float, float]:
        """Return the drift of each force [N]; arguments as for `apply`."""
        settings = self._settings
        if settings.drift_walk:
            step = settings.drift_walk * math.sqrt(duration)
            x, y = self._normal_pair()
            self._walk_x += step * x
            self._walk_y += step * y
        drift_x = drift_y = settings.drift_rate * time
        if settings.drift:
            angle = math.tau * time / settings.drift_period
            drift_x += settings.drift * math.sin(angle + self._phase_x)
            drift_y += settings.drift * math.sin(angle + self._phase_y)
        return drift_x + self._walk_x, drift_y + self._walk_y

    def _normal_pair(self) -> tuple[float, float]:
        """Return two normal deviates of variance 1, by the Box-Muller method."""
        angle = math.tau * self._random.random()
        radius = math.sqrt(-2.0 * math.log(1.0 - self._random.random()))
        return math.cos(angle) * radius, math.sin(angle) * radius

    def _student_pair(self) -> tuple[float, float]:
        """Return two deviates of Student's t-distribution, scaled to variance 1.

        Each is a normal deviate over the root of a chi-square deviate per degree of freedom.
        """
        freedom = self._settings.noise_freedom
        assert freedom is not None
        chi_square = self._random.gammavariate(0.5 * freedom, 2.0)
        x, y = self._normal_pair()
        other_chi_square = self._random.gammavariate(0.5 * freedom, 2.0)
        return (
            x * math.sqrt((freedom - 2.0) / chi_square),
            y * math.sqrt((freedom - 2.0) / other_chi_square),
        )


class Electronics:
    """Errors of the electronics on one of the two forces: hum, spikes and the steps of the ADC."""

    def __init__(self, settings: SimulationSettings, axis: str) -> None:
        """axis: `x` or `y`, which selects an independent sequence of random numbers"""
        self._settings = settings
        self._random = random.Random(f"electronics {axis} {settings.seed}")
        self._phase = self._random.uniform(0, math.tau)
        self._next_spike = self._time_to_next_spike()

    def read(self, force: float, time: float, duration: float, samples: int) -> float:
        """Return the measured force [N]; arguments as for `Imperfections.apply`."""
        settings = self._settings
        if settings.hum:
            angle = math.tau * settings.hum_frequency * (time - 0.5 * duration) + self._phase
            attenuation = _sine_attenuation(settings.hum_frequency * duration, samples)
            force += settings.hum * attenuation * math.sin(angle)
        if settings.spike_rate:
            force += self._spikes(time - duration, time) * settings.spike_size / max(1, samples)
        if settings.quantum:
            force = settings.quantum * round(force / settings.quantum)
        return force

    def _spikes(self, begin: float, end: float) -> int:
        """Return the spikes upwards minus those downwards, from `begin` to `end` [s]."""
        spikes = 0
        while self._next_spike < end:
            side = self._random.choice((-1, 1))
            if self._next_spike >= begin:  # earlier spikes fall between conversions
                spikes += side
            self._next_spike += self._time_to_next_spike()
        return spikes

    def _time_to_next_spike(self) -> float:
        rate = self._settings.spike_rate
        return self._random.expovariate(rate) if rate else math.inf


def _sine_attenuation(periods: float, samples: int) -> float:
    """Return the mean of a sine of amplitude 1 over a window of `periods`, as an amplitude.

    The sine is sampled at the midpoints of `samples` equal parts; 0: continuously.
    """
    angle = math.pi * periods
    if not samples:
        return math.sin(angle) / angle
    step = math.sin(angle / samples)
    if abs(step) < 1e-9:  # each sample equals the previous one, or its negative
        return math.cos(angle) / math.cos(angle / samples)
    return math.sin(angle) / (samples * step)
