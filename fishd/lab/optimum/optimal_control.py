"""The periodic command that thrusts most, of any shape and period, by Pontryagin's principle.

Nothing is known of the shape but |φ_c| ≤ Φ. The command is constant in each of many equal intervals
of a period; the wheel moves through them exactly, the fin answers as a linear filter, so only the
command and the period are unknown. The costate p of the wheel gives the slope of the mean thrust
in each of them, and scipy's L-BFGS-B climbs, from random commands.

Pontryagin's principle: φ_c enters the Hamiltonian only as p Ω tanh((φ_c − φ)/Δ), so the best φ_c is
Φ wherever p > 0 and −Φ wherever p < 0. A climb that ends shows whether that is so.
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
from fishd.virtual.plant.parameters import PlantParameters, of_the_paper
from fishd.virtual.plant.tethered import TetheredFish

Array = NDArray[np.float64]

STARTS = (1.0, 0.5, 0.7, 1.5)
"""Periods that climbs start from, over that of the lower of ω₀/2π and Ω/4Φ."""
_SHORTEST, _LONGEST = 0.2, 5.0
_HARMONICS = 3
_FULL = 1e-3
"""|φ_c| is Φ when it differs by less than this share."""
_LAPS, _SETTLED = 100, 1e-12
_LINEAR_LAG = 300.0  # in Δ; sinh does not overflow below
_EVALUATIONS = 1000


@dataclass(frozen=True)
class OptimalControl:
    """One period of the best command; it begins where the command turns upward.

    Arrays have shape (n,): an entry for each of n equal intervals, angles at its beginning.
    """

    amplitude: float
    """Φ [rad]"""
    time: Array
    """Beginning of each interval [s]."""
    command: Array
    """φ_c during the interval [rad]."""
    wheel: Array
    """φ [rad]"""
    fin: Array
    """α [rad]"""
    force: Array
    """Mean F_x during the interval [N]."""
    costate: Array
    """p, the slope of the mean thrust in φ; its largest size is 1."""
    period: float
    """[s]"""
    frequency: float
    """Tail beats per second; a period may hold several [Hz]."""
    thrust: float
    """Mean F_x over the period, integrated by the simulated fish [N]."""
    full: float
    """Share of the time in which |φ_c| = Φ, to 0.1 %."""
    agreement: float
    """Share of the time in which φ_c is on the side where Pontryagin's principle wants it."""
    best_square: SteadyState
    """The best square wave of the same fish and amplitude."""

    @property
    def ratio(self) -> float:
        """Thrust over that of the best square wave."""
        return self.thrust / self.best_square.thrust


def optimal_control(
    parameters: PlantParameters, amplitude: float, intervals: int = 200, seed: int = 0
) -> OptimalControl:
    """Find the periodic command within ±amplitude (rad) of greatest mean thrust; some seconds.

    The equations are those of Fu et al.: another model, quadratic drag, slack, backlash, dead zone,
    delay and reaction of the servo are left out.
    intervals: even; a reversal can be at the end of each

    Raises `ParameterError` without damping, where thrust has no bound.
    """
    if not (amplitude > 0.0 and intervals >= 8 and intervals % 2 == 0):
        raise ValueError(f"no optimal control for {amplitude} rad and {intervals} intervals")
    if parameters.xi == 0.0:
        raise ParameterError(
            "plant.xi: 0 is not possible here: without damping, thrust at ω₀ has no bound"
        )
    p = of_the_paper(parameters)
    best_square = best_square_wave(p, amplitude)
    problem = _Problem(p, amplitude, intervals)
    random = np.random.default_rng(seed)
    slower = min(p.omega0 / (2.0 * math.pi), p.servo_speed / (4.0 * amplitude))
    climbs = [
        problem.climb(_command(random, intervals), start / slower, 1.0 / slower) for start in STARTS
    ]
    return _described(problem, max(climbs, key=lambda climb: climb.thrust), best_square)


def _command(random: np.random.Generator, intervals: int) -> Array:
    """Some φ_c/Φ to start from: a few harmonics of random size and phase, up to a half."""
    phase = 2.0 * math.pi * np.arange(intervals) / intervals
    shifts = random.uniform(0.0, 2.0 * math.pi, _HARMONICS)
    sizes = random.normal(size=_HARMONICS)
    waves = [
        size * np.cos((k + 1) * phase + shift)
        for k, (size, shift) in enumerate(zip(sizes, shifts, strict=True))
    ]
    command = np.sum(waves, axis=0)
    return np.asarray(0.5 * command / np.max(np.abs(command)))


@dataclass(frozen=True)
class _Climb:
    """Where a climb has ended."""

    share: Array
    """φ_c/Φ in each interval."""
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
        """Thrust is counted in units of this [N]."""
        self._begun = 0.0
        """Where the wheel began the latest period [rad]."""

    def climb(self, share: Array, period: float, usual: float) -> _Climb:
        """Climb from a command φ_c/Φ; where that ends, take what Pontryagin wants, climb on.

        Where the wheel lags by several Δ its speed hardly depends on φ_c: there the thrust is so
        flat that a climb leaves the command anywhere, but the costate still has a side.
        usual: a period of the right size [s]
        """
        first = self._climbed(share, period, usual)
        wanted = np.where(first.costate == 0.0, first.share, np.sign(first.costate))
        second = self._climbed(wanted, first.period, usual)
        return max(first, second, key=lambda climb: climb.thrust)

    def _climbed(self, share: Array, period: float, usual: float) -> _Climb:
        from scipy.optimize import minimize  # the rest of the lab's optima does without

        def descend(x: Array) -> tuple[float, Array]:
            thrust, slope, _ = self.evaluate(x)
            return -thrust, -slope

        lowest, highest = math.log(_SHORTEST * usual), math.log(_LONGEST * usual)
        bounds = [(-1.0, 1.0)] * self.n + [(lowest, highest)]
        start = np.append(share, math.log(period))
        options: Any = {
            "maxiter": _EVALUATIONS,
            "maxfun": _EVALUATIONS,
            "ftol": 1e-12,
            "gtol": 1e-9,
        }
        found: Any = minimize(
            descend, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        end = found.x
        thrust, _, costate = self.evaluate(end)
        return _Climb(end[:-1], math.exp(end[-1]), thrust, costate)

    def evaluate(self, x: Array) -> tuple[float, Array, Array]:
        """Return the mean thrust, its slope in x, and the costate; thrust in plateaus.

        x: φ_c/Φ in each interval, and the logarithm of the period
        """
        p, n = self.p, self.n
        period = math.exp(x[-1])
        command = self.amplitude * x[:-1]
        wheel, lag, later = self._wheel(command, period / n)
        # sinh(later) = sinh(lag) exp(−Ωh/Δ), hence d later/d lag = tanh(later)/tanh(lag).
        still = math.exp(-period / n * p.servo_speed / p.servo_lag)
        kept = np.divide(
            np.tanh(later), np.tanh(lag), out=np.full(n, still), where=np.abs(lag) > 1e-9
        )
        spectrum = np.fft.rfft(wheel) / n
        gain, gain_slope = self._gains(period)
        twice = np.full(n // 2 + 1, 2.0)
        twice[[0, -1]] = 1.0
        power = twice * np.abs(spectrum) ** 2
        thrust = float(gain @ power)
        costate = self._costate(2.0 * np.fft.irfft(gain * spectrum, n), kept)
        in_command = self.amplitude * costate * (1.0 - kept)
        turned = p.servo_speed * period / n * np.tanh(later)  # dφ'/d ln(period)
        in_period = float(costate @ turned + gain_slope @ power)
        return thrust, np.append(in_command, in_period), costate

    def _wheel(self, command: Array, interval: float) -> tuple[Array, Array, Array]:
        """Wheel angle at the beginning of each interval (rad), lag there and at its end (Δ)."""
        delta = self.p.servo_lag
        time = interval * self.p.servo_speed / delta
        commands = command.tolist()
        phi, angles = self._begun, [0.0]
        decay, sinh, asinh = math.exp(-time), math.sinh, math.asinh
        near = 2.0 * self.amplitude < _LINEAR_LAG * delta
        for _ in range(_LAPS):
            begun, angles = phi, []
            for angle in commands:
                angles.append(phi)
                lag = (angle - phi) / delta
                phi = angle - delta * (asinh(decay * sinh(lag)) if near else relax(lag, time))
            if abs(phi - begun) <= _SETTLED * self.amplitude:
                break
        self._begun = phi
        wheel = np.array(angles)
        return wheel, (command - wheel) / delta, (command - np.append(wheel[1:], phi)) / delta

    def _gains(self, period: float) -> tuple[Array, Array]:
        """What the harmonics of φ thrust, in plateaus per rad², and its slope in ln(period).

        α̇ is φ filtered by iωλω₀²/(ω₀² − ω² + iξω₀ω). Between intervals φ is linear: each harmonic
        of its samples stands for higher ones, too, weaker by sinc².
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

    def _costate(self, direct: Array, kept: Array) -> Array:
        """The slope of thrust in φ at the end of each interval, whatever it does from there on."""
        directs, keeps = direct.tolist(), kept.tolist()
        costate, found = 0.0, [0.0] * self.n
        for lap in range(2):
            for k in range(self.n - 1, -1, -1):
                found[k] = costate
                costate = directs[k] + keeps[k] * costate
            if lap == 0:  # from zero; now from what repeats itself
                costate /= 1.0 - float(np.prod(kept))
        return np.array(found)


def _described(problem: _Problem, climb: _Climb, best_square: SteadyState) -> OptimalControl:
    """What the simulated fish makes of a command, begun where it turns upward."""
    share, costate = climb.share, climb.costate
    side = np.sign(share)
    upward = np.flatnonzero((np.roll(side, 1) < 0.0) & (side >= 0.0))
    first = int(upward[0]) if upward.size else 0
    share, costate, side = (np.roll(each, -first) for each in (share, costate, side))
    interval = climb.period / problem.n
    command = problem.amplitude * share
    wheel, fin, force = _swum(problem.p, command, interval)
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
        full=float(np.mean(np.abs(share) > 1.0 - _FULL)),
        agreement=float(np.mean(side == np.sign(costate))),
        best_square=best_square,
    )


def _swum(p: PlantParameters, command: Array, interval: float) -> tuple[Array, Array, Array]:
    """Wheel and fin angle before each interval (rad), and mean F_x in it (N), in periodic motion.

    A period is an affine map of (α, α̇), once the wheel repeats itself.
    """
    commands = command.tolist()
    fish = TetheredFish(p)
    for _ in range(_LAPS):
        begun = fish.state.phi
        for angle in commands:
            fish.advance(angle, interval, 1)
        if abs(fish.state.phi - begun) <= _SETTLED * p.servo_lag:
            break
    fish.state = PlantState(phi=fish.state.phi)
    free = np.eye(2)
    for angle in commands:
        for stretch in fish.advance(angle, interval, 1).course:
            free = stretch.segment.free_motion @ free
    forced = (fish.state.alpha, fish.state.alpha_rate)
    alpha, rate = np.linalg.solve(np.eye(2) - free, forced).tolist()
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
