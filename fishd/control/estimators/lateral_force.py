"""Fin velocity from the lateral force alone, with no model of the fish.

The water pushes back on a fin that is accelerated, so the lateral force is close to minus the fin's
acceleration: its leaky integral follows the fin velocity up to a positive scale. An offset of the
sensor would integrate to a drift; a slow average of the force estimates and subtracts it.
`LeakSearch` finds the leak that restores the fin velocity of the fish, by means of F_x.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fishd.control.estimators.base import Estimator
from fishd.core.estimation import DEFAULT_LEAK_S, EstimatorSettings
from fishd.core.signals import Measurement

Array = NDArray[np.float64]

MIN_LEAK_S, MAX_LEAK_S, BANK_SIZE = 0.02, 1.0, 12
"""Shortest and longest leak time of the bank [s], and their number, spaced logarithmically."""
ANGLE_LEAK_S = 5.0
"""Leak time of the integral that gives the fin angle: far longer than a beat [s]."""
RIPPLE_TIME_S = 0.5
"""Time constant of the high pass that isolates the ripple [s]."""
MEMORY_S = 10.0
"""Time constant of the averages of the correlation [s]."""
CHECK_INTERVAL_S = 2.0
"""Time between two evaluations of the correlation [s]."""
MIN_CORRELATION = 0.88
"""Smallest correlation of a product with the ripple of F_x with which its leak time is accepted."""
MIN_IMPROVEMENT = 2.0
"""Smallest factor by which the unexplained share of the ripple must decrease with a new leak."""
AGREEMENT_RATIO = 1.25
"""Largest ratio of the leak times of two successive evaluations that confirm each other."""


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


class LeakSearch:
    """A bank of leaky integrals of F_y, whose products are correlated with F_x.

    With the leak time T = K/K_d the leaky integral of F_y = −K (α̈ + α̇/T) is −K α̇, whatever the
    motion. The product of its integral and its rate then follows the ripple of F_x = −K α α̈. With
    another T the product leads or lags the ripple (Fu et al., the two forces). So several leak
    times run in parallel, and the one whose product correlates best with F_x is that of the fish.
    """

    def __init__(self, leak: float, bias_time: float) -> None:
        """
        leak: initial leak time [s]
        bias_time: time constant of the average that is subtracted from F_y beforehand [s]
        """
        self.leak = leak
        """Leak time in use [s]."""
        self.leaks: Array = np.geomspace(MIN_LEAK_S, MAX_LEAK_S, BANK_SIZE)
        # The average subtracted from F_y and the leak of the angle make the product lead. This
        # high pass makes the forces lead as much: it acts at twice the frequency, and only two of
        # the three factors of the product lead.
        time_constant = 1.0 / (4.0 / bias_time + 2.0 / ANGLE_LEAK_S)
        self._leading, self._forces = _HighPass(time_constant), _HighPass(RIPPLE_TIME_S)
        self._ripples = _HighPass(RIPPLE_TIME_S)
        zero = np.zeros(BANK_SIZE)
        self._velocity, self._angle = zero, zero
        self._powers, self._products, self._across = zero, zero, zero
        self._power = self._mixed = self._lateral = 0.0
        self._dt = self._time = self._candidate = 0.0
        self._decay = self._gain = zero

    def update(self, fx: float, fy: float, bias: float, dt: float) -> None:
        """Take in a window: its mean forces and the offset of F_y [N], and its length [s]."""
        if dt != self._dt:
            self._dt = dt
            self._decay = np.exp(-dt / self.leaks)
            self._gain = self.leaks * (1.0 - self._decay)
        before, angle = self._velocity, self._angle
        self._velocity = velocity = before * self._decay - self._gain * (fy - bias)
        self._angle = angle * math.exp(-dt / ANGLE_LEAK_S) + (0.5 * dt) * (velocity + before)
        ripple = self._ripples.filter((before - velocity) * (self._angle + angle), dt)
        forces = self._forces.filter(self._leading.filter(np.array([fx, fy]), dt), dt)
        force, lateral = forces.tolist()
        kept = math.exp(-dt / MEMORY_S)
        self._powers = self._powers * kept + ripple * ripple
        self._products = self._products * kept + ripple * force
        self._across = self._across * kept + ripple * lateral
        self._power = self._power * kept + force * force
        self._mixed = self._mixed * kept + force * lateral
        self._lateral = self._lateral * kept + lateral * lateral
        self._time += dt
        if self._time >= CHECK_INTERVAL_S:
            self._time = 0.0
            self._evaluate()

    def reverse_fy(self) -> None:
        """Reverse the sign of F_y from now on, also in the stored state that is odd in it."""
        self._velocity, self._angle = -self._velocity, -self._angle
        self._across, self._mixed = -self._across, -self._mixed
        for high_pass in (self._leading, self._forces):
            high_pass.scale(np.array([1.0, -1.0]))

    def _evaluate(self) -> None:
        before, self._candidate = self._candidate, self._best()
        if self._candidate and 1.0 / AGREEMENT_RATIO < before / self._candidate < AGREEMENT_RATIO:
            self.leak = self._candidate

    def _best(self) -> float:
        """Return the best leak time [s]; 0 if its correlation is low or hardly better."""
        fit, logs = self.fit, np.log(self.leaks)
        best = int(fit.argmax())
        present = float(np.interp(math.log(self.leak), logs, fit))
        unexplained = 1.0 - fit[best] ** 2
        if fit[best] < MIN_CORRELATION or 1.0 - present**2 < MIN_IMPROVEMENT * unexplained:
            return 0.0
        middle = min(max(best, 1), BANK_SIZE - 2)
        left, top, right = fit[middle - 1 : middle + 2].tolist()
        bend = left - 2.0 * top + right
        aside = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
        step = float(logs[1] - logs[0])
        return math.exp(float(logs[middle]) + step * max(-1.0, min(1.0, aside)))

    @property
    def fit(self) -> Array:
        """Partial correlation of the ripple of F_x with each product, shape (BANK_SIZE,).

        The part that both share with F_y is excluded, since a rotated sensor adds some F_y to F_x.
        """
        lateral = max(self._lateral, 1e-300)
        power = self._power - self._mixed**2 / lateral
        powers = self._powers - self._across**2 / lateral
        products = self._products - self._across * (self._mixed / lateral)
        return products / np.sqrt(np.maximum(powers * power, 1e-300))


class _HighPass:
    """A first-order high pass."""

    def __init__(self, time: float) -> None:
        """time: time constant [s]"""
        self._time = time
        self._slow: Array | None = None

    def scale(self, factors: Array) -> None:
        """Multiply the state of each channel by a factor."""
        if self._slow is not None:
            self._slow = self._slow * factors

    def filter(self, values: Array, dt: float) -> Array:
        """Return the filtered values, `dt` s after the previous ones."""
        slow = values if self._slow is None else self._slow
        self._slow = slow + (1.0 - math.exp(-dt / self._time)) * (values - slow)
        return values - self._slow
