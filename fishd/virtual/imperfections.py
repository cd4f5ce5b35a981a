"""Errors of a real rig's force measurement, as settings and as a function of time.

A real sensor is turned against the fish, carries an offset that drifts slowly, and is noisy. Mains
hum, a sample that is far off now and then, and the steps of an ADC come with its electronics.
"""

import math
import random
from typing import Annotated

from msgspec import Meta, Struct

from fishd.core.schema import note, unit
from fishd.virtual.plant.parameters import MotorSettings


class SimulationSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How imperfect the simulated rig is, and what its servo draws."""

    noise: Annotated[
        float,
        unit("N", "Noise of each force, rms of the mean over one tick.", ge=0, le=1, usual=0.1),
    ] = 1e-3
    noise_freedom: Annotated[
        Annotated[float, Meta(ge=2.1, le=1000)] | None,
        unit(
            "1",
            "Degrees of freedom of Student's t-distribution, for noise that has this one, with the "
            "same rms: the fewer, the more often a force is far off. null: Gaussian noise.",
        ),
    ] = None
    hum: Annotated[
        float,
        unit(
            "N",
            "Amplitude of mains hum on each force, in phases that depend on the seed.",
            ge=0,
            le=10,
            usual=0.5,
        ),
    ] = 0.0
    hum_frequency: Annotated[float, unit("Hz", "Frequency of that hum.", ge=0.1, le=1000)] = 50.0
    spike_rate: Annotated[
        float,
        unit(
            "1/s",
            "Spikes per second on each force, at random times: single samples that are far off.",
            ge=0,
            le=1000,
        ),
    ] = 0.0
    spike_size: Annotated[
        float,
        unit(
            "N",
            "How far off such a sample is, either way; a window is the mean of all its samples.",
            ge=0,
            le=100,
            usual=10,
        ),
    ] = 0.1
    quantum: Annotated[
        Annotated[float, Meta(ge=1e-9, le=1)] | None,
        unit("N", "Resolution of the mean force of a window; null for none."),
    ] = None
    offset_x: Annotated[float, unit("N", "Constant offset on F_x.", ge=-10, le=10, usual=1)] = 0.0
    offset_y: Annotated[float, unit("N", "Constant offset on F_y.", ge=-10, le=10, usual=1)] = 0.0
    drift: Annotated[
        float,
        unit(
            "N",
            "Amplitude of a slow drift of both offsets, a sine whose phase depends on the seed.",
            ge=0,
            le=10,
            usual=1,
        ),
    ] = 0.0
    drift_period: Annotated[float, unit("s", "Period of that sine.", gt=0, le=1e6)] = 60.0
    drift_rate: Annotated[
        float, unit("N/s", "A steady drift of both offsets beside it.", ge=-1, le=1)
    ] = 0.0
    drift_walk: Annotated[
        float,
        unit(
            "N/√s",
            "A random walk of each offset beside these: its standard deviation after a second.",
            ge=0,
            le=1,
        ),
    ] = 0.0
    rotation: Annotated[
        float,
        unit(
            "rad",
            "Angle by which the sensor's axes are turned against the fish.",
            ge=-math.pi,
            le=math.pi,
        ),
    ] = 0.0
    sample_rate: Annotated[
        float,
        unit(
            "1/s",
            "Pairs of samples per second; a window's mean is the mean of the samples that fall in "
            "it, at least one.",
            ge=1,
            le=10_000,
        ),
    ] = 200.0
    seed: Annotated[
        int, note("Same seed, same noise, drift, hum and spikes, to the last bit.", ge=0)
    ] = 0
    motor: Annotated[MotorSettings, note("The motor of the servo: what power it needs.")] = (
        MotorSettings()
    )

    @property
    def is_random(self) -> bool:
        """Return True where forces depend on the seed."""
        return any((self.noise, self.hum, self.spike_rate, self.drift, self.drift_walk))


class Imperfections:
    """Turns true forces into measured ones."""

    def __init__(self, settings: SimulationSettings, tick: float) -> None:
        """`tick` is the period that `settings.noise` refers to [s]."""
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
        """The forces as the rig shows them [N], for a window of `duration` that ends at `time` [s].

        time: since the start, for the same seed to mean the same drift in every run
        samples: how many, evenly spread, the window is the mean of; 0 where one conversion lasts
            all window long
        Noise of a longer window averages out as white noise does.
        """
        settings = self._settings
        if duration != self._duration:
            self._duration = duration
            self._deviation = settings.noise * math.sqrt(self._tick / duration)
        shown_x = self._cos * fx - self._sin * fy + settings.offset_x
        shown_y = self._sin * fx + self._cos * fy + settings.offset_y
        if self._drifts:
            drift_x, drift_y = self._drift(time, duration)
            shown_x += drift_x
            shown_y += drift_y
        x, y = self._normal_pair() if settings.noise_freedom is None else self._student_pair()
        shown_x += self._deviation * x
        shown_y += self._deviation * y
        if self._electronics:
            along, across = self._electronics
            shown_x = along.read(shown_x, time, duration, samples)
            shown_y = across.read(shown_y, time, duration, samples)
        return shown_x, shown_y

    def _drift(self, time: float, duration: float) -> tuple[float, float]:
        """Return the drift of either force [N]; the rest is as for `apply`."""
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
        """Return two normal deviates of variance 1, by the method of Box and Muller."""
        angle = math.tau * self._random.random()
        radius = math.sqrt(-2.0 * math.log(1.0 - self._random.random()))
        return math.cos(angle) * radius, math.sin(angle) * radius

    def _student_pair(self) -> tuple[float, float]:
        """Return two of Student's deviates of variance 1.

        Each is a normal one over the root of a chi-square per degree of freedom.
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
    """What they do to one of the two forces: hum, spikes and the steps of the ADC."""

    def __init__(self, settings: SimulationSettings, axis: str) -> None:
        """axis: `x` or `y`, for chances of its own"""
        self._settings = settings
        self._random = random.Random(f"electronics {axis} {settings.seed}")
        self._phase = self._random.uniform(0, math.tau)
        self._next_spike = self._wait()

    def read(self, force: float, time: float, duration: float, samples: int) -> float:
        """What is read of a force [N]; the rest is as for `Imperfections.apply`."""
        settings = self._settings
        if settings.hum:
            angle = math.tau * settings.hum_frequency * (time - 0.5 * duration) + self._phase
            left = _left_of_sine(settings.hum_frequency * duration, samples)
            force += settings.hum * left * math.sin(angle)
        if settings.spike_rate:
            force += self._spikes(time - duration, time) * settings.spike_size / max(1, samples)
        if settings.quantum:
            force = settings.quantum * round(force / settings.quantum)
        return force

    def _spikes(self, begin: float, end: float) -> int:
        """Those upwards less those downwards, from `begin` to `end` [s]."""
        spikes = 0
        while self._next_spike < end:
            side = self._random.choice((-1, 1))
            if self._next_spike >= begin:  # else nothing was converted then
                spikes += side
            self._next_spike += self._wait()
        return spikes

    def _wait(self) -> float:
        rate = self._settings.spike_rate
        return self._random.expovariate(rate) if rate else math.inf


def _left_of_sine(periods: float, samples: int) -> float:
    """Amplitude of the mean of a sine over a window of so many periods, for one of 1.

    It is taken at the midpoints of `samples` equal parts, or everywhere with 0.
    """
    angle = math.pi * periods
    if not samples:
        return math.sin(angle) / angle
    step = math.sin(angle / samples)
    if abs(step) < 1e-9:  # each sample of the hum is like the one before, or its opposite
        return math.cos(angle) / math.cos(angle / samples)
    return math.sin(angle) / (samples * step)
