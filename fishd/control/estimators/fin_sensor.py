"""Fin velocity from a sensor that measures it, without an estimate."""

from fishd.control.estimators.base import Estimator
from fishd.core.signals import Measurement


class FinSensor(Estimator):
    """An estimator that returns the fin velocity of the measurement."""

    def __init__(self) -> None:
        super().__init__()
        self._latest = 0.0

    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """Return the fin velocity [rad/s], see `Estimator.fin_velocity`.

        Raises ValueError where the sensor does not measure it.
        """
        if measurement.fin_velocity is not None:
            self._latest = measurement.fin_velocity
        elif measurement.samples:
            raise ValueError("estimator.kind is sensor, but the sensor measures no fin velocity")
        return self._latest
