"""Fin velocity in rad/s, from the lateral force and a model of the fish: a Kalman filter.

The model is the fish of section `plant`, which swims what the robot is told to: servo, delay and
play are known functions of the commands. What it gets wrong is corrected by the lateral force. Fin
angle, fin velocity and the sensor's offset are the state; the fin is linear, so their errors obey
linear equations, and the filter is the exact one for windows of any length.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.control.estimators.base import Estimator, EstimatorSettings
from fishd.control.estimators.lateral_sign import SETTLES
from fishd.core.signals import Measurement
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

Array = NDArray[np.float64]

_TERMS = 20
"""Of the series of a matrix exponential; enough for a norm of 0.5."""
_UNKNOWN = (0.05, 0.5, 0.1)
"""What is known at first of fin angle [rad], fin velocity [rad/s] and offset [N]."""


class Step(NamedTuple):
    """How errors of the state grow over a window, and what they do to its mean lateral force."""

    grow: Array
    """(3, 3)"""
    noise: Array
    """(3, 3), covariance of what is added meanwhile."""
    felt: Array
    """(3,), by the mean force, of the error at the start of the window."""
    shared: Array
    """(3,), covariance of what is added to the state and to the force."""
    variance: float
    """Of the force [N²]."""


class Observer(Estimator):
    """A Kalman filter for fin angle, fin velocity and the offset of F_y.

    The mean force of a window depends on the state at both of its ends, so the noise of the state
    and that of the measurement are correlated; see Anderson and Moore, "Optimal filtering", 5.5.
    """

    def __init__(self, settings: EstimatorSettings, plant: PlantParameters, tick: float) -> None:
        """tick: the period that `settings.force_noise` refers to [s]"""
        super().__init__()
        self._settings = settings
        self._plant = plant
        self._tick = tick
        self._fish = TetheredFish(plant)
        self._ahead = TetheredFish(replace(plant, servo_delay=0.0))
        """Its servo knows each instruction at once: so will the fish be after the delay."""
        self._later = _motion(plant, plant.servo_delay)[0]
        self._offset: float | None = None
        self._covariance: Array = np.diag(np.square(_UNKNOWN))
        self._step = lru_cache(maxsize=32)(self._window)

    def forget_zero(self) -> None:
        """As `Estimator.forget_zero`."""
        super().forget_zero()
        self._offset, self._covariance = None, np.diag(np.square(_UNKNOWN))

    def reverse_fy(self) -> None:
        """As `Estimator.reverse_fy`; the motion was corrected the wrong way, so it is not known."""
        super().reverse_fy()
        self._covariance = np.diag(np.square(_UNKNOWN))
        if self._offset is not None:
            self._offset = -self._offset

    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """As `Estimator.fin_velocity`, but after the servo's delay, when the next instruction acts.

        In rad/s.
        """
        settings, fish, ahead = self._settings, self._fish, self._ahead
        rotation = settings.sensor_rotation
        force = math.cos(rotation) * measurement.fy - math.sin(rotation) * measurement.fx
        if dt > SETTLES:  # fishd stood still: fin and water have forgotten what was before
            dt, self._offset, self._covariance = SETTLES, None, np.diag(np.square(_UNKNOWN))
        window = fish.advance(instruction_angle, dt, 1)
        ahead.advance(instruction_angle, dt, 1)
        step = self._step(round(dt, 9))
        P = self._covariance
        grown = step.grow @ P
        if not measurement.samples:  # nothing new was measured
            self._covariance = grown @ step.grow.T + step.noise
            return ahead.state.alpha_rate
        if self._offset is None:
            self._offset = force
        gain = grown @ step.felt + step.shared
        variance = float(step.felt @ P @ step.felt) + step.variance
        correction = gain * ((force - window.lateral_force - self._offset) / variance)
        self._covariance = grown @ step.grow.T + step.noise - np.outer(gain, gain) / variance
        alpha, rate, offset = correction.tolist()
        self._offset += offset
        self._correct(fish, alpha, rate)
        alpha, rate = (self._later @ correction[:2]).tolist()
        self._correct(ahead, alpha, rate)
        return ahead.state.alpha_rate

    @staticmethod
    def _correct(fish: TetheredFish, alpha: float, rate: float) -> None:
        state = fish.state
        fish.state = state._replace(alpha=state.alpha + alpha, alpha_rate=state.alpha_rate + rate)

    def _window(self, dt: float) -> Step:
        """For a window of `dt` s."""
        plant, settings = self._plant, self._settings
        motion, spread = _motion(plant, dt)
        spread = settings.disturbance**2 * spread
        wander = settings.offset_drift**2 * dt
        # F_y = −K_y α̈ − K_d α̇, so its mean is a difference between the ends of the window.
        ends = np.array([-plant.lateral_drag, -plant.lateral_inertia]) / dt
        grow, noise = np.eye(3), np.zeros((3, 3))
        grow[:2, :2] = motion
        noise[:2, :2], noise[2, 2] = spread, wander
        felt = np.append(ends @ (motion - np.eye(2)), 1.0)
        shared = np.append(spread @ ends, 0.5 * wander)
        white = settings.force_noise**2 * self._tick / dt
        return Step(grow, noise, felt, shared, float(ends @ spread @ ends) + wander / 3.0 + white)


def _motion(plant: PlantParameters, time: float) -> tuple[Array, Array]:
    """(2, 2), how the fin coasts; (2, 2), what white noise of its acceleration adds, for density 1.

    By the matrix exponential of Van Loan, "Computing integrals involving the matrix exponential",
    for a part of the time: of all of it, what grows as the fin comes to rest would overflow. Then
    the time is doubled.
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
    """By the series: nothing of scipy is on the robot."""
    total = term = np.eye(len(matrix))
    for power in range(1, _TERMS):
        term = term @ matrix / power
        total = total + term
    return total
