"""Periodic command of the largest thrust, of any shape and period, by Pontryagin's principle.

The only assumption on the shape is |φ_c| ≤ Φ. The command is constant in each of many equal
intervals of a period. The motion of the wheel in an interval is exact, and the fin is a linear
filter, so only the command and the period are unknown. The costate p of the wheel gives the slope
of the mean thrust in each interval; scipy's L-BFGS-B climbs with it from random commands.

Pontryagin's principle: φ_c enters the Hamiltonian only as p Ω tanh((φ_c − φ)/Δ), so the best φ_c is
Φ wherever p > 0 and −Φ wherever p < 0. The result of a climb shows whether it has this property.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import ParameterError
from fishd.virtual.plant.base import PlantState
from fishd.virtual.plant.drive_train import relax
from fishd.virtual.plant.optimum import SteadyState, best_square_wave
from fishd.virtual.plant.parameters import PlantParameters, without_extensions
from fishd.virtual.plant.tethered import TetheredFish

Array = NDArray[np.float64]

START_PERIODS = (1.0, 0.5, 0.7, 1.5)
"""Start periods of the climbs, in periods of the lower of ω₀/2π and Ω/4Φ."""
_MIN_PERIOD, _MAX_PERIOD = 0.2, 5.0
_HARMONIC_COUNT = 3
_FULL_TOLERANCE = 1e-3
"""Relative difference below which |φ_c| counts as Φ."""
_MAX_LAPS, _PERIODIC_TOLERANCE = 100, 1e-12
_LINEAR_LAG = 300.0  # in Δ; sinh does not overflow below this
_MAX_EVALUATIONS = 1000


@dataclass(frozen=True)
class OptimalControl:
    """One period of the best command, from an upward reversal of the command.

    Arrays have shape (n,): one entry for each of n equal intervals; angles are at its beginning.
    """

    amplitude: float
    """Amplitude Φ of the command [rad]."""
    time: Array
    """Beginning of each interval [s]."""
    command: Array
    """Command φ_c during the interval [rad]."""
    wheel: Array
    """Wheel angle φ [rad]."""
    fin: Array
    """Fin angle α [rad]."""
    force: Array
    """Mean F_x during the interval [N]."""
    costate: Array
    """Costate p, the slope of the mean thrust in φ, scaled to a largest magnitude of 1."""
    period: float
    """Period of the command [s]."""
    frequency: float
    """Tail beats per second [Hz]; a period may contain several beats."""
    thrust: float
    """Mean F_x over the period, integrated by the simulated fish [N]."""
    saturated_fraction: float
    """Fraction of the time in which |φ_c| = Φ, to 0.1 %."""
    costate_agreement: float
    """Fraction of the time in which φ_c has the sign of the costate, as Pontryagin requires."""
    best_square: SteadyState
    """Best square wave of the same fish and amplitude."""

    @property
    def ratio(self) -> float:
        """Thrust divided by the thrust of the best square wave."""
        return self.thrust / self.best_square.thrust


def optimal_control(
    parameters: PlantParameters, amplitude: float, intervals: int = 200, seed: int = 0
) -> OptimalControl:
    """Find the periodic command within ±amplitude (rad) of largest mean thrust; takes seconds.

    The equations are those of Fu et al.: other models, quadratic drag, slack, backlash, and dead
    zone, delay and reaction of the servo are left out.
    intervals: number of intervals, even; the command can reverse at the end of each

    Raises `ParameterError` without damping, as the thrust is then unbounded.
    """
    if not (amplitude > 0.0 and intervals >= 8 and intervals % 2 == 0):
        raise ValueError(f"no optimal control for {amplitude} rad and {intervals} intervals")
    if parameters.xi == 0.0:
        raise ParameterError(
            "plant.xi: 0 is not possible here: without damping, thrust at ω₀ has no bound"
        )
    p = without_extensions(parameters)
    best_square = best_square_wave(p, amplitude)
    problem = _Problem(p, amplitude, intervals)
    random = np.random.default_rng(seed)
    lower_frequency = min(p.omega0 / (2.0 * math.pi), p.servo_speed / (4.0 * amplitude))
    climbs = [
        problem.climb(
            _random_command(random, intervals), start / lower_frequency, 1.0 / lower_frequency
        )
        for start in START_PERIODS
    ]
    return _simulate_optimum(problem, max(climbs, key=lambda climb: climb.thrust), best_square)


def _random_command(random: np.random.Generator, intervals: int) -> Array:
    """Return a random start φ_c/Φ: a few harmonics of random size and phase, at most 0.5."""
    phase = 2.0 * math.pi * np.arange(intervals) / intervals
    shifts = random.uniform(0.0, 2.0 * math.pi, _HARMONIC_COUNT)
    sizes = random.normal(size=_HARMONIC_COUNT)
    waves = [
        size * np.cos((k + 1) * phase + shift)
        for k, (size, shift) in enumerate(zip(sizes, shifts, strict=True))
    ]
    command = np.sum(waves, axis=0)
    return np.asarray(0.5 * command / np.max(np.abs(command)))


@dataclass(frozen=True)
class _Climb:
    """Result of a climb."""

    share: Array
    """Command φ_c/Φ in each interval."""
    period: float
    thrust: float
    costate: Array


class _Problem:
    """Mean thrust of a periodic command, and its slope in the command and in the period."""

    def __init__(self, parameters: PlantParameters, amplitude: float, intervals: int) -> None:
        self.p = parameters
        self.amplitude = amplitude
        self.n = intervals
        self._plateau = parameters.thrust_coefficient * (
            (parameters.coupling * amplitude * parameters.omega0) ** 2
        )
        """Unit of the thrust inside this class [N]."""
        self._start_angle = 0.0
        """Wheel angle at the beginning of the latest period [rad]."""

    def climb(self, share: Array, period: float, usual: float) -> _Climb:
        """Climb from a command φ_c/Φ, then again from the sign of the resulting costate.

        If the wheel lags by several Δ, its speed hardly depends on φ_c. The thrust is then so flat
        that the first climb may end at any command, but the costate still has a sign.
        usual: typical period, which bounds the periods [s]
        """
        first = self._climb_once(share, period, usual)
        wanted = np.where(first.costate == 0.0, first.share, np.sign(first.costate))
        second = self._climb_once(wanted, first.period, usual)
        return max(first, second, key=lambda climb: climb.thrust)

    def _climb_once(self, share: Array, period: float, usual: float) -> _Climb:
        from scipy.optimize import minimize  # the other functions of this package do not need it

        def descend(x: Array) -> tuple[float, Array]:
            thrust, slope, _ = self.evaluate(x)
            return -thrust, -slope

        lowest, highest = math.log(_MIN_PERIOD * usual), math.log(_MAX_PERIOD * usual)
        bounds = [(-1.0, 1.0)] * self.n + [(lowest, highest)]
        start = np.append(share, math.log(period))
        options: Any = {
            "maxiter": _MAX_EVALUATIONS,
            "maxfun": _MAX_EVALUATIONS,
            "ftol": 1e-12,
            "gtol": 1e-9,
        }
        result: Any = minimize(
            descend, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        end = result.x
        thrust, _, costate = self.evaluate(end)
        return _Climb(end[:-1], math.exp(end[-1]), thrust, costate)

    def evaluate(self, x: Array) -> tuple[float, Array, Array]:
        """Return the mean thrust in units of the plateau, its slope in x, and the costate.

        x: φ_c/Φ in each interval, and the logarithm of the period
        """
        p, n = self.p, self.n
        period = math.exp(x[-1])
        command = self.amplitude * x[:-1]
        wheel, lag, lag_after = self._simulate_wheel(command, period / n)
        # sinh(lag_after) = sinh(lag) exp(−Ωh/Δ), so d lag_after/d lag = tanh(lag_after)/tanh(lag).
        decay_at_rest = math.exp(-period / n * p.servo_speed / p.servo_lag)
        decays = np.divide(
            np.tanh(lag_after),
            np.tanh(lag),
            out=np.full(n, decay_at_rest),
            where=np.abs(lag) > 1e-9,
        )
        spectrum = np.fft.rfft(wheel) / n
        gain, gain_slope = self._harmonic_gains(period)
        weights = np.full(n // 2 + 1, 2.0)
        weights[[0, -1]] = 1.0
        power = weights * np.abs(spectrum) ** 2
        thrust = float(gain @ power)
        costate = self._costate(2.0 * np.fft.irfft(gain * spectrum, n), decays)
        in_command = self.amplitude * costate * (1.0 - decays)
        turned = p.servo_speed * period / n * np.tanh(lag_after)  # dφ'/d ln(period)
        in_period = float(costate @ turned + gain_slope @ power)
        return thrust, np.append(in_command, in_period), costate

    def _simulate_wheel(self, command: Array, interval: float) -> tuple[Array, Array, Array]:
        """Return the wheel angle at the beginning of each interval (rad), and both lags (Δ)."""
        delta = self.p.servo_lag
        time = interval * self.p.servo_speed / delta
        commands = command.tolist()
        phi, angles = self._start_angle, [0.0]
        decay, sinh, asinh = math.exp(-time), math.sinh, math.asinh
        is_small = 2.0 * self.amplitude < _LINEAR_LAG * delta
        for _ in range(_MAX_LAPS):
            start, angles = phi, []
            for angle in commands:
                angles.append(phi)
                lag = (angle - phi) / delta
                phi = angle - delta * (asinh(decay * sinh(lag)) if is_small else relax(lag, time))
            if abs(phi - start) <= _PERIODIC_TOLERANCE * self.amplitude:
                break
        self._start_angle = phi
        wheel = np.array(angles)
        return wheel, (command - wheel) / delta, (command - np.append(wheel[1:], phi)) / delta

    def _harmonic_gains(self, period: float) -> tuple[Array, Array]:
        """Return the thrust of each harmonic of φ [plateaus/rad²], and its slope in ln(period).

        α̇ is φ filtered by iωλω₀²/(ω₀² − ω² + iξω₀ω). Between the samples φ is linear, so each
        harmonic of the samples also represents higher ones, weaker by sinc².
        """
        p, n = self.p, self.n
        gain, slope = np.zeros(n // 2 + 1), np.zeros(n // 2 + 1)
        for alias in (-1, 0, 1):
            harmonics = np.arange(n // 2 + 1) + alias * n
            r = 2.0 * math.pi * harmonics / (period * p.omega0)
            below = (1.0 - r**2) ** 2 + (p.xi * r) ** 2
            below_slope = 2.0 * r**2 * (p.xi**2 - 2.0 * (1.0 - r**2))  # r d/dr
            shape = np.sinc(harmonics / n) ** 4 / self.amplitude**2
            gain += shape * r**2 / below
            slope -= shape * (2.0 * r**2 * below - r**2 * below_slope) / below**2
        return gain, slope

    def _costate(self, direct: Array, decay_factors: Array) -> Array:
        """Return the slope of the thrust in φ at the end of each interval, computed backwards."""
        direct_slopes, decays = direct.tolist(), decay_factors.tolist()
        costate, costates = 0.0, [0.0] * self.n
        for lap in range(2):
            for k in range(self.n - 1, -1, -1):
                costates[k] = costate
                costate = direct_slopes[k] + decays[k] * costate
            if lap == 0:  # the first lap started from zero; now start from the periodic value
                costate /= 1.0 - float(np.prod(decay_factors))
        return np.array(costates)


def _simulate_optimum(problem: _Problem, climb: _Climb, best_square: SteadyState) -> OptimalControl:
    """Return the simulated motion and thrust of a command, from its upward reversal."""
    share, costate = climb.share, climb.costate
    side = np.sign(share)
    upward = np.flatnonzero((np.roll(side, 1) < 0.0) & (side >= 0.0))
    shift = int(upward[0]) if upward.size else 0
    share, costate, side = (np.roll(values, -shift) for values in (share, costate, side))
    interval = climb.period / problem.n
    command = problem.amplitude * share
    wheel, fin, force = _simulate_period(problem.p, command, interval)
    reversals = np.count_nonzero(np.roll(side, 1) != side)
    return OptimalControl(
        amplitude=problem.amplitude,
        time=np.arange(problem.n) * np.float64(interval),
        command=command,
        wheel=wheel,
        fin=fin,
        force=force,
        costate=costate / np.max(np.abs(costate)),
        period=climb.period,
        frequency=0.5 * reversals / climb.period,
        thrust=float(np.mean(force)),
        saturated_fraction=float(np.mean(np.abs(share) > 1.0 - _FULL_TOLERANCE)),
        costate_agreement=float(np.mean(side == np.sign(costate))),
        best_square=best_square,
    )


def _simulate_period(
    p: PlantParameters, command: Array, interval: float
) -> tuple[Array, Array, Array]:
    """Return the periodic wheel and fin angles before each interval (rad), and its mean F_x (N).

    Once the wheel is periodic, a period is an affine map of (α, α̇).
    """
    commands = command.tolist()
    fish = TetheredFish(p)
    for _ in range(_MAX_LAPS):
        start = fish.state.phi
        for angle in commands:
            fish.advance(angle, interval, 1)
        if abs(fish.state.phi - start) <= _PERIODIC_TOLERANCE * p.servo_lag:
            break
    fish.state = PlantState(phi=fish.state.phi)
    free_motion = np.eye(2)
    for angle in commands:
        for stretch in fish.advance(angle, interval, 1).course:
            free_motion = stretch.segment.free_motion @ free_motion
    forced_motion = (fish.state.alpha, fish.state.alpha_rate)
    alpha, rate = np.linalg.solve(np.eye(2) - free_motion, forced_motion).tolist()
    fish.state = PlantState(fish.state.phi, alpha, rate)
    states, forces = [], []
    for angle in commands:
        states.append(fish.state)
        forces.append(fish.advance(angle, interval, 1).thrust)
    return (
        np.array([state.phi for state in states]),
        np.array([state.alpha for state in states]),
        np.array(forces),
    )
