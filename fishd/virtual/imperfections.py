"""Errors of a real rig's force measurement, as settings and as a function of time.

A real sensor is turned against the fish, carries an offset that drifts slowly, and is noisy.
"""

import math
import random
from typing import Annotated

from msgspec import Struct

from fishd.core.schema import note, unit
from fishd.virtual.plant.motor import MotorSettings


class SimulationSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How imperfect the simulated rig is, and what its servo draws."""

    noise: Annotated[
        float, unit("N", "Noise of each force, rms of the mean over one tick.", ge=0, le=1)
    ] = 1e-3
    offset_x: Annotated[float, unit("N", "Constant offset on F_x.", ge=-10, le=10)] = 0.0
    offset_y: Annotated[float, unit("N", "Constant offset on F_y.", ge=-10, le=10)] = 0.0
    drift: Annotated[
        float,
        unit(
            "N",
            "Amplitude of a slow drift of both offsets, a sine whose phase depends on the seed.",
            ge=0,
            le=10,
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
    seed: Annotated[int, note("Same seed, same noise and drift, to the last bit.", ge=0)] = 0
    motor: Annotated[MotorSettings, note("The motor of the servo: what power it needs.")] = (
        MotorSettings()
    )


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

    def apply(self, fx: float, fy: float, time: float, duration: float) -> tuple[float, float]:
        """The forces as the rig shows them [N], for a window of `duration` that ends at `time` [s].

        time: since the start, for the same seed to mean the same drift in every run
        Noise of a longer window averages out as white noise does.
        """
        settings = self._settings
        gauss = self._random.gauss
        noise = settings.noise * math.sqrt(self._tick / duration)
        if settings.drift_walk:
            step = settings.drift_walk * math.sqrt(duration)
            self._walk_x += gauss(0.0, step)
            self._walk_y += gauss(0.0, step)
        angle = math.tau * time / settings.drift_period
        steady = settings.drift_rate * time
        drift_x = settings.drift * math.sin(angle + self._phase_x) + steady + self._walk_x
        drift_y = settings.drift * math.sin(angle + self._phase_y) + steady + self._walk_y
        return (
            self._cos * fx - self._sin * fy + settings.offset_x + drift_x + gauss(0.0, noise),
            self._sin * fx + self._cos * fy + settings.offset_y + drift_y + gauss(0.0, noise),
        )
