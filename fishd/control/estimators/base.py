"""The base class of estimators, and their settings."""

from abc import ABC, abstractmethod
from typing import Annotated, Literal

from msgspec import Meta, Struct
from msgspec.structs import replace

from fishd.control.estimators.tail_beat import TailBeat
from fishd.core.schema import note, unit
from fishd.core.signals import Measurement, Observation

DEFAULT_LEAK_S, MAX_LEAK_S = 0.3, 100.0
"""Default and largest leak time [s]; K/K_d is 0.323 s for the fish of Fu et al."""


class EstimatorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the estimator of fin velocity and thrust."""

    kind: Annotated[
        Literal["lateral_force", "observer", "sensor"],
        note(
            "lateral_force integrates F_y and knows nothing of the fish; observer is a Kalman "
            "filter on the fish of section plant, as fishctl identify finds it; sensor takes the "
            "angular velocity of the tail against the front body, which a swimmer measures."
        ),
    ] = "lateral_force"
    leak: Annotated[
        Annotated[float, Meta(gt=0, le=MAX_LEAK_S)] | Literal["auto"],
        unit(
            "s",
            "Of lateral_force: time constant with which the integral of the lateral force decays; "
            "best is K/K_d. auto: start with 0.3, and search for the leak that fits F_x.",
        ),
    ] = DEFAULT_LEAK_S
    bias_time: Annotated[
        float,
        unit(
            "s",
            "Of lateral_force: time constant of the average that tracks the offset of F_y.",
            gt=0,
            le=1000,
        ),
    ] = 2.0
    zero_drift: Annotated[
        float,
        unit(
            "N/√s",
            "How fast the zero of F_x drifts: standard deviation of its change in a second, by "
            "which the interval of the thrust grows.",
            ge=0,
            le=1,
        ),
    ] = 6e-4
    force_noise: Annotated[
        float, unit("N", "Of observer: noise of F_y, rms of the mean over one tick.", gt=0, le=1)
    ] = 1e-3
    offset_drift: Annotated[
        float,
        unit(
            "N/√s",
            "Of observer: standard deviation of the change of the offset of F_y in a second.",
            ge=0,
            le=1,
        ),
    ] = 1e-3
    disturbance: Annotated[
        float,
        unit(
            "rad/s/√s",
            "Of observer: standard deviation of the change of the fin velocity in a second by what "
            "the model lacks.",
            gt=0,
            le=1000,
        ),
    ] = 1.0
    reversed_fy: Annotated[
        Literal["correct", "refuse", "warn"],
        note(
            "Reaction to a first push of the tail that shows that F_y is reversed. correct: "
            "estimator and controllers use F_y with the other sign, and status says so. refuse: "
            "mode fault, and no controller that uses F_y starts until F_y or the servo is "
            "calibrated. warn: status says so, and the fish swims badly."
        ),
    ] = "correct"
    sensor_rotation: Annotated[
        float,
        unit(
            "rad",
            "Of observer: angle by which the sensor's axes are turned against the fish.",
            ge=-1.5,
            le=1.5,
        ),
    ] = 0.0


class Estimator(ABC):
    """An estimator: adds force rate, fin velocity, thrust and beat frequency to measurements."""

    def __init__(self) -> None:
        self.fy_corrected = False
        """Whether the sign of the measured F_y is reversed before use."""
        self.found_leak: float | None = None
        """Leak time in use [s], if the estimator finds it; else None."""
        self._fy: float | None = None
        self._angle: float | None = None
        self._beat = TailBeat()

    def rest(self) -> None:
        """Note that no controller moves the tail any more, so it does not beat."""
        self._beat.rest()

    def forget_zero(self) -> None:
        """Discard earlier forces, since the zero of the sensor was set."""
        self._fy = None

    def reverse_fy(self) -> None:
        """Reverse the sign of F_y from now on, also in the stored state."""
        self.fy_corrected = not self.fy_corrected
        if self._fy is not None:
            self._fy = -self._fy

    def update(
        self,
        measurement: Measurement,
        instruction_angle: float,
        time: float,
        dt: float,
        thrust_factor: tuple[float, float] | None = None,
    ) -> Observation:
        """Return the observation of the tick at `time`.

        instruction_angle: angle applied since the previous tick [rad]
        time: start of the tick [s, monotonic]
        dt: time since the previous tick [s]
        thrust_factor: latest factor of the thrust, and the half-width of its interval [N]
        """
        factor, ci95 = thrust_factor or (None, None)
        if self.fy_corrected:
            measurement = replace(measurement, fy=-measurement.fy)
        fy = measurement.fy
        fy_rate = (fy - self._fy) / dt if self._fy is not None else 0.0
        if measurement.samples:
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
            fin_velocity=self.fin_velocity(measurement, instruction_angle, dt),
            instruction_angle=instruction_angle,
            previous_angle=before,
            thrust=self._beat.thrust,
            frequency=self._beat.frequency,
            thrust_factor=factor,
            thrust_factor_error=ci95,
            side_time=self._beat.side_time,
        )

    @abstractmethod
    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """Return the fin velocity at the end of a measurement; called once a tick.

        measurement: with the corrected sign of F_y
        """
