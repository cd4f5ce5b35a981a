"""Forces that disturb a simulated sensor, unknown to fishd: drifts, steps, noise and outliers."""

import math
import random
from collections.abc import Callable

import numpy as np

Force = Callable[[float, bool], float]
"""Force that is added to F_x [N], by the time since the start [s] and whether the fish swims."""
Disturbance = Callable[[random.Random, float], Force]
"""Function that returns a force with a random shape for a run of a length [s]."""


def warm_up(tau: float) -> Disturbance:
    """Return a drift of 20 mN with a time constant."""
    return lambda chance, seconds: lambda time, swims: 0.02 * -math.expm1(-time / tau)


def sine(period: float) -> Disturbance:
    """Return a sine of 5 mN with a random phase."""

    def disturb(chance: random.Random, seconds: float) -> Force:
        phase = chance.uniform(0.0, math.tau)
        return lambda time, swims: 5e-3 * math.sin(math.tau * time / period + phase)

    return disturb


def steps(size: float, per_minute: float | None = None) -> Disturbance:
    """Return steps in either direction at random times; one step where no rate is given."""

    def disturb(chance: random.Random, seconds: float) -> Force:
        times = random_times(chance, seconds, per_minute or 0.0)
        if per_minute is None:
            times = [chance.uniform(0.0, seconds)]
        sizes = np.cumsum([0.0, *(chance.choice((-size, size)) for _ in times)])
        return lambda time, swims: float(sizes[np.searchsorted(times, time, "right")])

    return disturb


def line(rate: float) -> Disturbance:
    """Return a steady drift [N/s]."""
    return lambda chance, seconds: lambda time, swims: rate * time


def walk(deviation: float) -> Disturbance:
    """Return a random walk with a standard deviation after one second [N/√s]."""

    def disturb(chance: random.Random, seconds: float) -> Force:
        step = 0.05
        changes = np.random.default_rng(chance.getrandbits(32)).standard_normal(
            int(seconds / step) + 2
        )
        level = deviation * math.sqrt(step) * np.cumsum(changes)
        return lambda time, swims: float(level[int(time / step)])

    return disturb


def flicker(chance: random.Random, seconds: float) -> Force:
    """Return noise with a 1/f spectrum from the inverse length of the run to 10 Hz, 5 mN rms."""
    step, count = 0.05, int(seconds / 0.05) + 2
    spectrum = np.fft.rfft(np.random.default_rng(chance.getrandbits(32)).standard_normal(count))
    spectrum[0] = 0.0
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    noise = np.fft.irfft(spectrum, count)
    noise *= 5e-3 / noise.std()
    return lambda time, swims: float(noise[int(time / step)])


def follow_swimming(chance: random.Random, seconds: float) -> Force:
    """Return a first-order response to swimming of 2 mN with a time constant of 10 s."""
    latest = level = 0.0

    def force(time: float, swims: bool) -> float:
        nonlocal latest, level
        level += (swims - level) * -math.expm1((latest - time) / 10.0)
        latest = time
        return 2e-3 * level

    return force


def outliers(chance: random.Random, seconds: float) -> Force:
    """Return ticks that are off by 20 to 100 mN and times of 0.6 s by 3 to 10 mN, six a minute."""
    pulses = []
    for start in random_times(chance, seconds, 6.0):
        length, low, high = chance.choice(((0.05, 20e-3, 100e-3), (0.6, 3e-3, 10e-3)))
        size = chance.choice((-1, 1)) * chance.uniform(low, high)
        pulses.append((start, start + length, size))
    return lambda time, swims: sum(size for start, end, size in pulses if start <= time < end)


def random_times(chance: random.Random, seconds: float, per_minute: float) -> list[float]:
    """Return the times of a Poisson process [s]; empty for a rate of zero."""
    times: list[float] = []
    while per_minute:
        previous = times[-1] if times else 0.0
        times.append(previous + chance.expovariate(per_minute / 60.0))
        if times[-1] > seconds:
            return times[:-1]
    return times
