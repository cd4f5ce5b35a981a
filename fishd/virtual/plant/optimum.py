"""Best periodic square wave from the equations, the reference for every controller.

The periodic state of the tethered fish is computed directly, without the simulation of a transient.
A fin with quadratic drag, a servo with another law than tanh, and a plant of another package are
simulated until the beats are equal.
"""

import cmath
import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from fishd.virtual.plant.base import PlantState
from fishd.virtual.plant.drive_train import lag_after_reversal
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.registry import open_plant
from fishd.virtual.plant.tethered import AnyWindow, TetheredFish

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_FREQUENCY_TOLERANCE = 1e-4
"""Relative error of the best frequency; the thrust is flat there."""

# Far below ω₀ and the frequency Ω/4Φ at which the servo saturates, thrust is proportional to the
# frequency; above ω₀ it falls. With the heaviest allowed damping, the best frequency is 0.18 of the
# lower of the two.
_SCAN_FACTOR_BELOW = 8.0
_SCAN_FACTOR_ABOVE = 1.5
_SCAN_POINTS = 32

_THRUST_TOLERANCE = 1e-7
"""Relative error of the thrust of a simulated fish."""
_SCAN_TOLERANCE = 1e-3
"""Relative error of the thrust during the scan of frequencies."""
_MAX_BEATS = 200


class SteadyState(NamedTuple):
    """Result of a periodic wave after the decay of transients."""

    frequency: float  # Hz
    thrust: float  # mean of F_x over a period, N
    fin_amplitude: float  # largest |α|, rad


def fast_servo_thrust(parameters: PlantParameters, amplitude: float, frequency: float) -> float:
    """Return the mean thrust (N) of a square wave that the wheel follows at once, φ = φ_c.

    This is the closed form of Fu et al., for an amplitude in rad and a frequency in Hz. Numerator
    and denominator are divided by exp(ξx), so that low frequencies do not overflow. Slack, backlash
    and dead zone are ignored.
    """
    p = parameters
    x = p.omega0 / (4.0 * frequency)
    d = cmath.sqrt(p.xi**2 - 4.0)

    def scaled(exponent: complex) -> complex:
        return cmath.exp((exponent - p.xi) * x)

    def sinh_over(k: complex) -> complex:
        return (scaled(k) - scaled(-k)) / (2.0 * k) if k else x * scaled(0.0)

    cosh_sum = (scaled(d) + scaled(-d) + scaled(p.xi) + scaled(-p.xi)) / 2.0
    shape = (4.0 * frequency / p.omega0) * (sinh_over(p.xi) - sinh_over(d)) / cosh_sum
    plateau = p.thrust_coefficient * (p.coupling * amplitude * p.omega0) ** 2
    return plateau * shape.real


def square_wave(parameters: PlantParameters, amplitude: float, frequency: float) -> SteadyState:
    """Return the periodic regime of φ_c = ±amplitude (rad) reversed twice per period (Hz)."""
    if not _is_linear(parameters):
        return _SimulatedFish(parameters, amplitude).simulate(frequency, _THRUST_TOLERANCE)
    window = _half_period(parameters, amplitude, frequency)
    return SteadyState(frequency, window.thrust, window.fin_peak)


@lru_cache(maxsize=256)
def best_square_wave(parameters: PlantParameters, amplitude: float) -> SteadyState:
    """Return the square wave of this amplitude (rad) with the largest thrust over all frequencies.

    With weak damping there are local maxima at odd fractions of ω₀/2π, hence the scan before the
    refinement. The maximum at ω₀/2π is narrow, hence that frequency is one point of the scan.
    Without damping, the thrust there is unbounded, and rounding limits the result.
    """
    scan = _scan(parameters, amplitude)
    thrust = _thrust_of_waves(parameters, amplitude)
    logs = [math.log(frequency) for frequency in scan]
    thrusts = [thrust(frequency, _SCAN_TOLERANCE) for frequency in scan]
    best = min(max(thrusts.index(max(thrusts)), 1), len(logs) - 2)
    log = _find_maximum(lambda x: thrust(math.exp(x)), logs[best - 1], logs[best + 1])
    return square_wave(parameters, amplitude, math.exp(log))


def swims_forwards(parameters: PlantParameters, amplitude: float) -> bool:
    """Return whether a square wave of this amplitude (rad) has a thrust above zero.

    Unlike the best square wave, this mostly needs one frequency.
    """
    thrust = _thrust_of_waves(parameters, amplitude)
    scan = reversed(_scan(parameters, amplitude))  # high ones are simulated faster
    return any(thrust(frequency, _SCAN_TOLERANCE) > 0.0 for frequency in scan)


def _scan(parameters: PlantParameters, amplitude: float) -> list[float]:
    """Return frequencies of which one is near the best, in order [Hz]."""
    p = parameters
    resonance = p.omega0 / (2.0 * math.pi)
    saturated = p.servo_speed / (4.0 * amplitude)
    lowest = min(resonance, saturated) / _SCAN_FACTOR_BELOW
    return sorted(
        [resonance, *np.geomspace(lowest, _SCAN_FACTOR_ABOVE * resonance, _SCAN_POINTS).tolist()]
    )


def _thrust_of_waves(parameters: PlantParameters, amplitude: float) -> Callable[..., float]:
    """Return the function that returns the thrust [N] of a frequency [Hz], to a precision."""
    fish = None if _is_linear(parameters) else _SimulatedFish(parameters, amplitude)

    def thrust(frequency: float, precision: float = _THRUST_TOLERANCE) -> float:
        if fish:
            return fish.simulate(frequency, precision).thrust
        return _half_period(parameters, amplitude, frequency).thrust

    return thrust


def _is_linear(parameters: PlantParameters) -> bool:
    """Return whether half a period is an affine map of the fin's state."""
    p = parameters
    return p.model == TETHERED and p.servo_law == "tanh" and not p.quadratic_drag


class _SimulatedFish:
    """Simulated fish under square waves of one amplitude (rad)."""

    def __init__(self, parameters: PlantParameters, amplitude: float) -> None:
        # The delay only shifts the motion, and the reaction does not change the thrust.
        self._fish = open_plant(replace(parameters, servo_delay=0.0, servo_reaction=0.0))
        self._amplitude = amplitude

    def simulate(self, frequency: float, precision: float) -> SteadyState:
        """Simulate beats until the rest of the transient is below a precision of the thrust.

        The change from beat to beat decreases by a factor r, so the remaining change is r/(1 − r)
        of it. Two small changes in a row are required, because one may be small where it changes
        its sign.
        """
        half_period = 0.5 / frequency
        thrust = change = math.inf
        peak, good_beats = 0.0, 0
        for _ in range(_MAX_BEATS):
            forth = self._fish.advance(self._amplitude, half_period, samples=1)
            back = self._fish.advance(-self._amplitude, half_period, samples=1)
            before, thrust = thrust, 0.5 * (forth.thrust + back.thrust)
            earlier, change = change, abs(thrust - before)
            peak = max(forth.fin_peak, back.fin_peak)
            ratio = change / earlier if earlier else 0.0
            left = change * ratio / (1.0 - ratio) if ratio < 1.0 else math.inf
            good_beats = (
                good_beats + 1 if earlier < math.inf and left <= precision * abs(thrust) else 0
            )
            if good_beats == 2:
                break
        return SteadyState(frequency, thrust, peak)


def _half_period(parameters: PlantParameters, amplitude: float, frequency: float) -> AnyWindow:
    """Return the half period after a reversal to +amplitude, in the periodic regime.

    Half a period is an affine map of (α, α̇); by antisymmetry, it negates the state of the periodic
    regime. The servo's delay only shifts the motion, and its reaction does not change the thrust:
    both are set to zero.
    """
    p = replace(parameters, servo_delay=0.0, servo_reaction=0.0)
    half_period = 0.5 / frequency
    swing = max(0.0, amplitude - p.servo_dead_zone)  # angle that the wheel reaches
    lag = p.servo_lag * lag_after_reversal(
        2.0 * swing / p.servo_lag, half_period * p.servo_speed / p.servo_lag
    )
    fish = TetheredFish(p, PlantState(phi=swing - lag))
    fish.cables.tail = tail = min(0.0, swing - lag + p.backlash)
    from_rest = fish.advance(amplitude, half_period, samples=1)
    forced = (fish.state.alpha, fish.state.alpha_rate)
    free = np.eye(2)
    for stretch in from_rest.course:
        free = stretch.segment.free_motion @ free
    alpha, rate = np.linalg.solve(free + np.eye(2), np.negative(forced)).tolist()
    fish.state = PlantState(swing - lag, alpha, rate)
    fish.cables.tail = tail
    return fish.advance(amplitude, half_period, samples=1)


def _find_maximum(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the position of the only maximum of a function in low … high, by golden sections."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = function(left), function(right)
    while high - low > _FREQUENCY_TOLERANCE:
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = function(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = function(right)
    return 0.5 * (low + high)
