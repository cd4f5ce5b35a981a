"""Best square wave as a function of the amplitude Φ, and its limits of a fast and a slow servo."""

from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from fishd.virtual.plant.optimum import SteadyState, best_square_wave, fast_servo_thrust
from fishd.virtual.plant.parameters import PlantParameters, without_extensions

Array = NDArray[np.float64]

_FAST_SERVO_SPEED, _FAST_SERVO_LAG = 1e4, 1e-4
"""Speed in units of ω₀, and lag in units of Φ, of a servo that follows the command at once."""


@dataclass(frozen=True)
class Optima:
    """Square waves of largest thrust; arrays have shape (n,), one entry for each amplitude."""

    amplitude: Array
    """Amplitude Φ [rad]."""
    frequency: Array
    """Frequency of largest thrust [Hz]."""
    thrust: Array
    """Mean F_x over a period [N]."""
    fin_amplitude: Array
    """Largest |α| [rad]."""


def saturation_amplitude(parameters: PlantParameters) -> float:
    """Return Φ_s = Ω/ω₀ [rad]; the servo is fast for Φ ≪ Φ_s, slow for Φ ≫ Φ_s (Fu et al.)."""
    return parameters.servo_speed / parameters.omega0


def best_square_waves(parameters: PlantParameters, amplitudes: ArrayLike) -> Optima:
    """Return the best square waves of the full equations, each at its best frequency.

    amplitudes: Φ, shape (n,) [rad]

    Raises ValueError for an amplitude that is not positive.
    """
    angles = _to_angles(amplitudes)
    return _make_optima(angles, [best_square_wave(parameters, angle) for angle in angles.tolist()])


def fast_servo(parameters: PlantParameters, amplitudes: ArrayLike) -> Optima:
    """Return the limit Φ ≪ Φ_s and Δ ≪ Φ, in which the wheel follows at once, φ = φ_c.

    The frequency is the same for every amplitude; the thrust is the closed form of Fu et al., and
    grows as Φ². Slack, backlash and dead zone are left out.
    amplitudes: Φ, shape (n,) [rad]. Raises ValueError for an amplitude that is not positive.
    """
    angles = _to_angles(amplitudes)
    unit = best_square_wave(_with_fast_servo(parameters), 1.0)
    thrust = [fast_servo_thrust(parameters, angle, unit.frequency) for angle in angles.tolist()]
    frequency = np.full(angles.shape, unit.frequency)
    return Optima(angles, frequency, np.array(thrust), unit.fin_amplitude * angles)


def slow_servo(parameters: PlantParameters, amplitudes: ArrayLike) -> Optima:
    """Return the limit Φ ≫ Φ_s, in which the wheel turns at ±Ω and just reaches ±Φ (Fu et al.).

    Frequency Ω/4Φ, thrust Kλ²Ω², fin amplitude λΦ: the fin follows the wheel.
    amplitudes: Φ, shape (n,) [rad]. Raises ValueError for an amplitude that is not positive.
    """
    p, angles = parameters, _to_angles(amplitudes)
    plateau = p.thrust_coefficient * (p.coupling * p.servo_speed) ** 2
    frequency = p.servo_speed / (4.0 * angles)
    return Optima(angles, frequency, np.full(angles.shape, plateau), p.coupling * angles)


def _with_fast_servo(parameters: PlantParameters) -> PlantParameters:
    """Return the parameters with a servo that follows at once an amplitude of 1 rad."""
    return replace(
        without_extensions(parameters),
        servo_speed=_FAST_SERVO_SPEED * parameters.omega0,
        servo_lag=_FAST_SERVO_LAG,
    )


def _to_angles(amplitudes: ArrayLike) -> Array:
    angles = np.atleast_1d(np.asarray(amplitudes, dtype=np.float64))
    if angles.ndim != 1 or not np.all(angles > 0.0):
        raise ValueError(f"amplitudes must be positive and in one row, not {amplitudes!r}")
    return angles


def _make_optima(angles: Array, states: list[SteadyState]) -> Optima:
    frequency, thrust, fin = np.array(states, dtype=np.float64).reshape(-1, 3).T
    return Optima(angles, frequency, thrust, fin)
