"""The best square wave against the amplitude Φ, and what a fast and a slow servo make of it."""

from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from fishd.virtual.plant.optimum import SteadyState, best_square_wave, fast_servo_thrust
from fishd.virtual.plant.parameters import PlantParameters, of_the_paper

Array = NDArray[np.float64]

_FASTER, _CLOSER = 1e4, 1e-4
"""A servo that turns so much faster than the fin, and lags so much less than Φ, is not felt."""


@dataclass(frozen=True)
class Optima:
    """Square waves of greatest thrust; each array has shape (n,), an entry for each amplitude."""

    amplitude: Array
    """Φ [rad]"""
    frequency: Array
    """[Hz]"""
    thrust: Array
    """Mean F_x over a period [N]."""
    fin_amplitude: Array
    """Largest |α| [rad]."""


def saturation_amplitude(parameters: PlantParameters) -> float:
    """Φ_s = Ω/ω₀ [rad]: the servo is fast for Φ ≪ Φ_s and slow for Φ ≫ Φ_s (Fu et al.)."""
    return parameters.servo_speed / parameters.omega0


def best_square_waves(parameters: PlantParameters, amplitudes: ArrayLike) -> Optima:
    """Of the whole equations, at the best of all frequencies; amplitudes: Φ, of shape (n,) [rad].

    Raises ValueError for an amplitude that is not positive.
    """
    angles = _angles(amplitudes)
    return _optima(angles, [best_square_wave(parameters, angle) for angle in angles.tolist()])


def fast_servo(parameters: PlantParameters, amplitudes: ArrayLike) -> Optima:
    """With a wheel that follows at once, φ = φ_c: the limit Φ ≪ Φ_s and Δ ≪ Φ.

    The frequency is the same for every amplitude; the thrust is the closed form of Fu et al., and
    grows as Φ². Slack, backlash and dead zone are left out.
    amplitudes: Φ, of shape (n,) [rad]. Raises ValueError for one that is not positive.
    """
    angles = _angles(amplitudes)
    unit = best_square_wave(_with_fast_servo(parameters), 1.0)
    thrust = [fast_servo_thrust(parameters, angle, unit.frequency) for angle in angles.tolist()]
    frequency = np.full(angles.shape, unit.frequency)
    return Optima(angles, frequency, np.array(thrust), unit.fin_amplitude * angles)


def slow_servo(parameters: PlantParameters, amplitudes: ArrayLike) -> Optima:
    """With a wheel that always turns at ±Ω and just reaches ±Φ: the limit Φ ≫ Φ_s (Fu et al.).

    Frequency Ω/4Φ, thrust Kλ²Ω², fin amplitude λΦ: the fin follows the wheel.
    amplitudes: Φ, of shape (n,) [rad]. Raises ValueError for one that is not positive.
    """
    p, angles = parameters, _angles(amplitudes)
    plateau = p.thrust_coefficient * (p.coupling * p.servo_speed) ** 2
    frequency = p.servo_speed / (4.0 * angles)
    return Optima(angles, frequency, np.full(angles.shape, plateau), p.coupling * angles)


def _with_fast_servo(parameters: PlantParameters) -> PlantParameters:
    """For an amplitude of 1 rad."""
    return replace(
        of_the_paper(parameters),
        servo_speed=_FASTER * parameters.omega0,
        servo_lag=_CLOSER,
    )


def _angles(amplitudes: ArrayLike) -> Array:
    angles = np.atleast_1d(np.asarray(amplitudes, dtype=np.float64))
    if angles.ndim != 1 or not np.all(angles > 0.0):
        raise ValueError(f"amplitudes must be positive and in one row, not {amplitudes!r}")
    return angles


def _optima(angles: Array, states: list[SteadyState]) -> Optima:
    frequency, thrust, fin = np.array(states, dtype=np.float64).reshape(-1, 3).T
    return Optima(angles, frequency, thrust, fin)
