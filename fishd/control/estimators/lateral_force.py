"""Fin velocity from the lateral force alone, with no model of the fish.

The water pushes back on a fin that is accelerated, so the lateral force is close to minus the fin's
acceleration: its leaky integral follows the fin velocity up to a positive scale. An offset of the
sensor would integrate to a drift; a slow average of the force estimates and subtracts it.
"""

import math

from fishd.control.estimators.base import Estimator
from fishd.control.estimators.leak_search import LeakSearch
from fishd.core.estimation import DEFAULT_LEAK_S, EstimatorSettings
from fishd.core.signals import Measurement


class LateralForceEstimator(Estimator):
    """An estimator of the fin velocity, up to a positive scale: a leaky integral of F_y."""

    def __init__(self, settings: EstimatorSettings) -> None:
        super().__init__()
        self._settings = settings
        self._leak = DEFAULT_LEAK_S if settings.leak == "auto" else settings.leak
        self._search = (
            LeakSearch(DEFAULT_LEAK_S, settings.bias_time) if settings.leak == "auto" else None
        )
        self.found_leak = self._leak if self._search else None
        self._dt = self._kept = self._share = 0.0
        """Length of the latest window [s]; fraction of the integral kept over it, and fraction of
        the offset replaced in it."""
        self._bias: float | None = None
        self._fin_velocity = 0.0

    def forget_zero(self) -> None:
        """Discard earlier forces, see `Estimator.forget_zero`."""
        super().forget_zero()
        self._bias, self._fin_velocity = None, 0.0

    def reverse_fy(self) -> None:
        """Reverse the sign of F_y, see `Estimator.reverse_fy`."""
        super().reverse_fy()
        self._fin_velocity = -self._fin_velocity
        if self._bias is not None:
            self._bias = -self._bias
        if self._search:
            self._search.reverse_fy()

    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """Return about K times the fin velocity [N s], see `Estimator.fin_velocity`."""
        fy = measurement.fy
        if self._bias is None:
            if not measurement.samples:
                return 0.0
            self._bias = fy
        if dt != self._dt:
            self._dt = dt
            self._kept = math.exp(-dt / self._leak)
            self._share = -math.expm1(-dt / self._settings.bias_time)
        self._bias += self._share * (fy - self._bias)
        if self._search:
            self._search.update(measurement.fx, fy, self._bias, dt)
            self.found_leak = self._leak = self._search.leak
            self._kept = math.exp(-dt / self._leak)
        self._fin_velocity *= self._kept
        self._fin_velocity -= (fy - self._bias) * dt
        return self._fin_velocity
