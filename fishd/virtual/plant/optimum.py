"""The best periodic square wave, from the equations: the yardstick of every controller.

The periodic state of the tethered fish is solved for directly, without simulating a transient. A
fin with quadratic drag, and a plant of another package, swim until each beat is like the last.
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
_PRECISION = 1e-4  # of the best frequency, relative; the thrust is flat there

# Far below ω₀ and the frequency Ω/4Φ at which the servo saturates, thrust grows as the frequency;
# above ω₀ it falls. The heaviest damping allowed puts the best at 0.18 of the lower of the two.
_SCAN_BELOW = 8.0
_SCAN_ABOVE = 1.5
_SCANNED = 32

_SETTLED = 1e-7  # of the thrust of a fish that swims, relative
_ROUGHLY = 1e-3  # while it is only to be seen which frequencies are worth a closer look
_MOST_BEATS = 200


class SteadyState(NamedTuple):
    """What a periodic command amounts to once transients have died out."""

    frequency: float  # Hz
    thrust: float  # mean of F_x over a period, N
    fin_amplitude: float  # largest |α|, rad


def fast_servo_thrust(parameters: PlantParameters, amplitude: float, frequency: float) -> float:
    """Return the mean thrust (N) of a square wave that the wheel follows at once, φ = φ_c.

    The closed form of Fu et al., for an amplitude in rad and a frequency in Hz, with numerator and
    denominator both divided by exp(ξx) so that low frequencies do not overflow. Slack, backlash
    and dead zone are left out.
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
    if not _linear(parameters):
        return _Swimming(parameters, amplitude).settled(frequency, _SETTLED)
    window = _half_period(parameters, amplitude, frequency)
    return SteadyState(frequency, window.thrust, window.fin_peak)


@lru_cache(maxsize=256)
def best_square_wave(parameters: PlantParameters, amplitude: float) -> SteadyState:
    """Return the square wave of this amplitude (rad) that thrusts most, over all frequencies.

    Weak damping brings local maxima at odd fractions of ω₀/2π, hence a scan before the refinement,
    and a maximum at ω₀/2π too narrow for a scan to meet by chance. Without any damping the thrust
    there has no bound, and the answer is only as large as rounding lets it be.
    """
    p = parameters
    resonance = p.omega0 / (2.0 * math.pi)
    saturated = p.servo_speed / (4.0 * amplitude)
    lowest = min(resonance, saturated) / _SCAN_BELOW
    scan = sorted([resonance, *np.geomspace(lowest, _SCAN_ABOVE * resonance, _SCANNED).tolist()])

    swimming = None if _linear(p) else _Swimming(p, amplitude)

    def thrust(log_frequency: float, precision: float = _SETTLED) -> float:
        frequency = math.exp(log_frequency)
        if swimming:
            return swimming.settled(frequency, precision).thrust
        return _half_period(p, amplitude, frequency).thrust

    logs = [math.log(frequency) for frequency in scan]
    thrusts = [thrust(x, _ROUGHLY) for x in logs]
    best = min(max(thrusts.index(max(thrusts)), 1), len(logs) - 2)
    return square_wave(p, amplitude, math.exp(_maximum(thrust, logs[best - 1], logs[best + 1])))


def _linear(parameters: PlantParameters) -> bool:
    """Is the fin's state after half a period an affine map of that before?"""
    return parameters.model == TETHERED and not parameters.quadratic_drag


class _Swimming:
    """A fish that swims square waves of one amplitude (rad), one after the other."""

    def __init__(self, parameters: PlantParameters, amplitude: float) -> None:
        # As for a linear fin, what shifts all in time or is no thrust is left out.
        self._fish = open_plant(replace(parameters, servo_delay=0.0, servo_reaction=0.0))
        self._amplitude = amplitude

    def settled(self, frequency: float, precision: float) -> SteadyState:
        """Swim until what is left of the transient is within a precision of the thrust.

        The change from beat to beat shrinks by some factor r, so r/(1 − r) of it is still to come.
        It may also change its sign, and be small once for that alone.
        """
        half_period = 0.5 / frequency
        thrust = change = math.inf
        peak, good = 0.0, 0
        for _ in range(_MOST_BEATS):
            there = self._fish.advance(self._amplitude, half_period, samples=1)
            back = self._fish.advance(-self._amplitude, half_period, samples=1)
            before, thrust = thrust, 0.5 * (there.thrust + back.thrust)
            earlier, change = change, abs(thrust - before)
            peak = max(there.fin_peak, back.fin_peak)
            shrinks = change / earlier if earlier else 0.0
            left = change * shrinks / (1.0 - shrinks) if shrinks < 1.0 else math.inf
            good = good + 1 if earlier < math.inf and left <= precision * abs(thrust) else 0
            if good == 2:
                break
        return SteadyState(frequency, thrust, peak)


def _half_period(parameters: PlantParameters, amplitude: float, frequency: float) -> AnyWindow:
    """Return the half period after a reversal to +amplitude, in the periodic regime.

    Half a period is an affine map of (α, α̇); by antisymmetry the regime is what it negates. The
    servo's delay shifts it in time, its reaction is no thrust: both are left out.
    """
    p = replace(parameters, servo_delay=0.0, servo_reaction=0.0)
    half_period = 0.5 / frequency
    swing = max(0.0, amplitude - p.servo_dead_zone)  # as far as the wheel goes
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


def _maximum(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function with one maximum in low … high has it, by golden sections."""
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_left, at_right = function(left), function(right)
    while high - low > _PRECISION:
        if at_left > at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = function(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = function(right)
    return 0.5 * (low + high)
