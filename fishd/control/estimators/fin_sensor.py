"""Fin velocity from a sensor that tells it: nothing is estimated."""

from fishd.control.estimators.base import Estimator
from fishd.core.signals import Measurement


class FinSensor(Estimator):
    """Takes the fin velocity of the measurement."""

    def __init__(self) -> None:
        super().__init__()
        self._latest = 0.0

    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """As `Estimator.fin_velocity`; in rad/s.

        Raises ValueError where the sensor does not tell it.
        """
        if measurement.fin_velocity is not None:
            self._latest = measurement.fin_velocity
        elif measurement.samples:
            raise ValueError("estimator.kind is sensor, and the sensor tells no fin velocity")
        return self._latest
