"""The base class of estimators."""

from abc import ABC, abstractmethod

from msgspec.structs import replace

from fishd.control.estimators.tail_beat import TailBeat
from fishd.core.signals import Measurement, Observation


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
            thrust_factor_ci95=ci95,
            side_time=self._beat.side_time,
        )

    @abstractmethod
    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """Return the fin velocity at the end of a measurement; called once a tick.

        measurement: with the corrected sign of F_y
        """
