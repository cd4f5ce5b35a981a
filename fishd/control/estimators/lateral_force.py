"""Fin velocity from the lateral force alone, with no model of the fish.

The water pushes back on a fin that is accelerated, so the lateral force is close to minus the fin's
acceleration: its leaky integral follows the fin velocity up to a positive scale. An offset of the
sensor would integrate to a lie; a slow average of the force finds it and takes it off.
"""

import math
from typing import Annotated

from msgspec import Struct

from fishd.control.estimators.tail_beat import TailBeat
from fishd.core.schema import unit
from fishd.core.signals import Measurement, Observation


class EstimatorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How fin velocity and thrust are found."""

    leak: Annotated[
        float,
        unit(
            "s", "Time constant by which the integral of the lateral force forgets.", gt=0, le=100
        ),
    ] = 0.3
    bias_time: Annotated[
        float,
        unit(
            "s",
            "Time constant of the average that tracks the offset of the lateral force.",
            gt=0,
            le=1000,
        ),
    ] = 2.0
    zero_drift: Annotated[
        float,
        unit(
            "N/√s",
            "How fast the zero of F_x wanders, standard deviation after a second: by this the "
            "interval of the thrust grows.",
            ge=0,
            le=1,
        ),
    ] = 6e-4


class LateralForceEstimator:
    """Adds force rate, fin velocity, thrust and tail-beat frequency to each measurement."""

    def __init__(self, settings: EstimatorSettings) -> None:
        self._settings = settings
        self._bias: float | None = None
        self._fin_velocity = 0.0
        self._fy = 0.0
        self._angle: float | None = None
        self._beat = TailBeat()

    def rest(self) -> None:
        """Note that nobody moves the tail any more: it does not beat."""
        self._beat.rest()

    def update(
        self, measurement: Measurement, instruction_angle: float, time: float, dt: float
    ) -> Observation:
        """The observation for the tick at `time`.

        instruction_angle: applied since the previous tick [rad]
        time: start of the tick [s, monotonic]
        dt: time since the previous tick [s]
        """
        fy = measurement.fy
        if self._bias is None:
            self._bias = self._fy = fy
        self._bias -= math.expm1(-dt / self._settings.bias_time) * (fy - self._bias)
        self._fin_velocity *= math.exp(-dt / self._settings.leak)
        self._fin_velocity -= (fy - self._bias) * dt
        fy_rate = (fy - self._fy) / dt
        self._fy = fy
        before = instruction_angle if self._angle is None else self._angle
        self._angle = instruction_angle
        self._beat.update(instruction_angle, measurement.fx, dt)
        return Observation(
            time=time,
            dt=dt,
            fx=measurement.fx,
            fy=fy,
            fy_rate=fy_rate,
            fin_velocity=self._fin_velocity,
            instruction_angle=instruction_angle,
            previous_angle=before,
            thrust=self._beat.thrust,
            frequency=self._beat.frequency,
        )
