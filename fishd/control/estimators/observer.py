"""Fin velocity in rad/s, from the lateral force and a model of the fish: a Kalman filter.

The model is the fish of section `plant`, which receives the instruction angles of the robot: servo,
delay and play are known functions of them. The lateral force corrects the errors of the model. Fin
angle, fin velocity and the offset of the sensor are the state. The fin is linear, so their errors
obey linear equations, and the filter is exact for windows of any length.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.control.estimators.base import Estimator
from fishd.control.estimators.lateral_sign import SETTLE_TIME_S
from fishd.core.estimation import EstimatorSettings
from fishd.core.signals import Measurement
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

Array = NDArray[np.float64]

_SERIES_TERMS = 20
"""Number of terms of the series of a matrix exponential; enough for a norm of 0.5."""
_INITIAL_SDS = (0.05, 0.5, 0.1)
"""Initial standard deviations of fin angle [rad], fin velocity [rad/s] and offset [N]."""


class Step(NamedTuple):
    """The propagation of state errors over a window, and their effect on its mean lateral force."""

    transition: Array
    """Transition matrix of the errors, shape (3, 3)."""
    noise: Array
    """Covariance of the process noise, shape (3, 3)."""
    sensitivity: Array
    """Derivatives of the mean force by the errors at the start of the window, shape (3,)."""
    cross_covariance: Array
    """Covariance between the noise of the state and that of the force, shape (3,)."""
    variance: float
    """Variance of the mean force by noise [N²]."""


class Observer(Estimator):
    """A Kalman filter for fin angle, fin velocity and the offset of F_y.

    The mean force of a window depends on the state at both of its ends, so the noise of the state
    and that of the measurement are correlated; see Anderson and Moore, "Optimal filtering", 5.5.
    """

    def __init__(self, settings: EstimatorSettings, plant: PlantParameters, tick: float) -> None:
        """tick: period that `settings.force_noise` refers to [s]"""
        super().__init__()
        self._settings = settings
        self._plant = plant
        self._tick = tick
        self._fish = TetheredFish(plant)
        self._undelayed = TetheredFish(replace(plant, servo_delay=0.0))
        """A fish whose servo has no delay: the state of the real fish after the delay."""
        self._delay_transition = _motion(plant, plant.servo_delay)[0]
        self._offset: float | None = None
        self._covariance: Array = np.diag(np.square(_INITIAL_SDS))
        self._step = lru_cache(maxsize=32)(self._propagation)

    def forget_zero(self) -> None:
        """Discard earlier forces, see `Estimator.forget_zero`."""
        super().forget_zero()
        self._offset, self._covariance = None, np.diag(np.square(_INITIAL_SDS))

    def reverse_fy(self) -> None:
        """Reverse the sign of F_y; the motion was corrected the wrong way, so it is unknown."""
        super().reverse_fy()
        self._covariance = np.diag(np.square(_INITIAL_SDS))
        if self._offset is not None:
            self._offset = -self._offset

    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """Return the fin velocity after the servo's delay, when the next instruction acts [rad/s].

        See `Estimator.fin_velocity`.
        """
        settings, fish, undelayed = self._settings, self._fish, self._undelayed
        rotation = settings.sensor_rotation
        force = math.cos(rotation) * measurement.fy - math.sin(rotation) * measurement.fx
        if dt > SETTLE_TIME_S:  # fishd was suspended, and the motion of fin and water has decayed
            dt, self._offset = SETTLE_TIME_S, None
            self._covariance = np.diag(np.square(_INITIAL_SDS))
        window = fish.advance(instruction_angle, dt, 1)
        undelayed.advance(instruction_angle, dt, 1)
        step = self._step(round(dt, 9))
        P = self._covariance
        grown = step.transition @ P
        if not measurement.samples:  # nothing new was measured
            self._covariance = grown @ step.transition.T + step.noise
            return undelayed.state.alpha_rate
        if self._offset is None:
            self._offset = force
        gain = grown @ step.sensitivity + step.cross_covariance
        variance = float(step.sensitivity @ P @ step.sensitivity) + step.variance
        correction = gain * ((force - window.lateral_force - self._offset) / variance)
        self._covariance = grown @ step.transition.T + step.noise - np.outer(gain, gain) / variance
        alpha, rate, offset = correction.tolist()
        self._offset += offset
        self._correct(fish, alpha, rate)
        alpha, rate = (self._delay_transition @ correction[:2]).tolist()
        self._correct(undelayed, alpha, rate)
        return undelayed.state.alpha_rate

    @staticmethod
    def _correct(fish: TetheredFish, alpha: float, rate: float) -> None:
        state = fish.state
        fish.state = state._replace(alpha=state.alpha + alpha, alpha_rate=state.alpha_rate + rate)

    def _propagation(self, dt: float) -> Step:
        """Return the propagation over a window of `dt` s."""
        plant, settings = self._plant, self._settings
        motion, spread = _motion(plant, dt)
        spread = settings.disturbance**2 * spread
        wander = settings.offset_drift**2 * dt
        # F_y = −K_y α̈ − K_d α̇, so its mean is a difference between the ends of the window.
        ends = np.array([-plant.lateral_drag, -plant.lateral_inertia]) / dt
        transition, noise = np.eye(3), np.zeros((3, 3))
        transition[:2, :2] = motion
        noise[:2, :2], noise[2, 2] = spread, wander
        sensitivity = np.append(ends @ (motion - np.eye(2)), 1.0)
        cross_covariance = np.append(spread @ ends, 0.5 * wander)
        white = settings.force_noise**2 * self._tick / dt
        variance = float(ends @ spread @ ends) + wander / 3.0 + white
        return Step(transition, noise, sensitivity, cross_covariance, variance)


def _motion(plant: PlantParameters, time: float) -> tuple[Array, Array]:
    """Return the transition matrix of the coasting fin, and the covariance by noise.

    Both have the shape (2, 2); the noise is white, that of the acceleration of the fin, and has the
    density 1. They are computed with the matrix exponential of Van Loan, "Computing
    integrals involving the matrix exponential", for a fraction of the time, which is then doubled
    repeatedly: for the whole time, the growing part of the exponential would overflow.
    """
    fin = np.array([[0.0, 1.0], [-(plant.omega0**2), -plant.xi * plant.omega0]])
    block = np.zeros((4, 4))
    block[:2, :2], block[2:, 2:] = -fin, fin.T
    block[1, 3] = 1.0
    size = float(np.abs(block).sum(axis=1).max()) * time
    doublings = math.ceil(math.log2(max(size, 0.5))) + 1
    moved = _exponential(block * (time / 2.0**doublings))
    motion = moved[2:, 2:].T
    spread = motion @ moved[:2, 2:]
    for _ in range(doublings):
        spread = spread + motion @ spread @ motion.T
        motion = motion @ motion
    return motion, spread


def _exponential(matrix: Array) -> Array:
    """Return the exponential of a matrix by its series; scipy is not installed on the robot."""
    total = term = np.eye(len(matrix))
    for power in range(1, _SERIES_TERMS):
        term = term @ matrix / power
        total = total + term
    return total
