"""Natural frequency and damping of a free swimmer, from steps of its muscles in still water."""

import math

import numpy as np
from msgspec import Struct
from scipy.optimize import least_squares

from fishd.virtual.swimmer import feasibility
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import SwimmerSettings

PERIODS = 2.4
"""Duration of a response, in natural periods as estimated before."""
MAX_XI = 10.0
"""Damping above which a response shows only ω₀/ξ."""
_DAMPING_GUESSES = 0.1, 0.7, 1.4, 3.0


class StepResponse(Struct, frozen=True, kw_only=True):
    """Oscillator that fits the angle of the tail after a step of the activation.

    In the convention of Fu et al.: α̈ + ξω₀α̇ + ω₀²(α − α_c) = 0. ξ = 2 is critical damping.
    """

    activation: float
    """Height of the step of a, from 0."""
    omega0: float
    """Natural frequency ω₀ [rad/s]."""
    xi: float
    """Damping ξ."""
    angle: float
    """Angle α_c of the tail at the end, against the front body [rad]."""
    misfit: float
    """Root mean square of the difference from the fit, relative to `angle`."""


def swim_step(settings: SwimmerSettings, activation: float) -> tuple[Array, Array]:
    """Return times [s] and angles of the tail [rad] after a step from rest.

    settings: as accepted by `feasibility.check`
    Raises `Diverged` where the fish cannot be computed.
    """
    fish = Fish(settings)
    steps = math.ceil(PERIODS / feasibility.estimate(settings).frequency / fish.dt)
    times, angles = np.empty(steps), np.empty(steps)
    for index in range(steps):
        fish.step(activation)
        motion = fish.motion()
        times[index], angles[index] = motion.time, motion.tail_angle
    return times, angles


def fit(activation: float, times: Array, angles: Array) -> StepResponse:
    """Return the oscillator that fits a response; times [s] count from the step."""
    guess = 4.0 * math.pi / times[-1]
    fits = [
        least_squares(
            lambda p: response(times, *p) - angles,
            (guess, damping, angles[-1]),
            x_scale=(guess, 1.0, abs(angles[-1]) or 1.0),
            bounds=((1e-3 * guess, 1e-6, -np.inf), (1e3 * guess, 1e3, np.inf)),
        )
        for damping in _DAMPING_GUESSES
    ]
    best = min(fits, key=lambda result: float(result.cost))
    omega0, xi, angle = map(float, best.x)
    rms = math.sqrt(2.0 * float(best.cost) / len(times))
    misfit = rms / abs(angle) if angle else math.inf
    return StepResponse(activation=activation, omega0=omega0, xi=xi, angle=angle, misfit=misfit)


def response(times: Array, omega0: float, xi: float, angle: float) -> Array:
    """Return the angle of the oscillator of `StepResponse` after a step, from rest [rad]."""
    rate = 0.5 * xi * omega0
    root = np.sqrt(complex(rate**2 - omega0**2)) or 1e-9 * omega0
    slow, fast = np.exp((root - rate) * times), np.exp(-(root + rate) * times)
    falling = 0.5 * (slow + fast + rate / root * (slow - fast))
    return np.asarray(angle * (1.0 - falling.real))
