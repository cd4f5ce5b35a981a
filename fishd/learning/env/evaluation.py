"""Deterministic evaluations during a training: how does the policy swim without exploration?"""

import itertools
import math
from collections.abc import Callable

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.config import Config
from fishd.learning.environment import SwimEnv
from fishd.learning.evaluation import judge
from fishd.learning.settings import EvaluationSettings, TrainingSettings
from fishd.learning.variation import at_edge
from fishd.signals import Observation

STALLED = 0.05
"""A mean |φ_c| below this share of Φ is no swimming."""
CHATTER = 0.9
"""Nor is it to reverse in more than this share of the ticks: the fin does not follow."""

SHAKE = 1.0
"""How long a fish is shaken [s]."""

Decide = Callable[[Observation], float]
"""A policy: observation in, instruction angle out [rad]."""


class Trial(Struct, frozen=True):
    """What an evaluation came to."""

    thrust: float
    """Mean thrust [N]: the true one of a simulated fish, the measured one of another."""
    frequency: float
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    tick: float
    """Period of the loop [s]."""

    @property
    def stalled(self) -> bool:
        """Does the policy hold still, or nearly so, or reverse in nearly every tick?"""
        reversals = 2.0 * self.frequency * self.tick
        return self.frequency == 0.0 or self.fullness < STALLED or reversals > CHATTER


def in_simulation(config: Config, decide: Decide, settings: EvaluationSettings) -> Trial:
    """A fresh fish as configured, not one of a randomised training, and with other noise."""
    other = replace(config.simulation, seed=config.simulation.seed + 1)
    found = judge(replace(config, simulation=other), decide, settings.seconds, settings.settle)
    return Trial(
        float(found.mean_thrust), float(found.frequency), float(found.fullness), config.tick
    )


def worst_of_others(config: Config, decide: Decide, settings: TrainingSettings) -> float:
    """Lowest efficiency on fish at the edges of the randomisation, each over its own optimum.

    They begin in rapid reversals, a place where some policies stay for ever.
    """
    trial = settings.evaluation
    return min(
        judge(
            at_edge(config, settings.randomisation, seed),
            shaken(decide, config),
            trial.seconds,
            trial.settle,
        ).efficiency
        for seed in range(trial.others)
    )


def shaken(decide: Decide, config: Config) -> Decide:
    """Reverse in every tick at first, and decide only then."""
    ticks = itertools.count()

    def decided(observation: Observation) -> float:
        tick = next(ticks)
        if tick * config.tick < SHAKE:
            return config.amplitude_limit * (-1.0) ** tick
        return decide(observation)

    return decided


def on_link(
    env: SwimEnv, decide: Decide, settings: EvaluationSettings, stop: Callable[[], bool]
) -> Trial | None:
    """The very fish that learns, by its measured thrust; None where `stop` says so on the way.

    It rests before and after, so that the thrust can be told from what the sensor drifts meanwhile.
    The fish must not be at pause. Raises `LinkLost`.
    """
    tick, amplitude = env.link.tick, env.link.amplitude
    before = _force_at_rest(env, settings.rest, stop)
    ticks = math.ceil(settings.seconds / tick)
    settled = round(settings.settle / tick)
    times, thrusts, angles = [], [], []
    for index in range(ticks):
        if stop():
            return None
        angle = max(-amplitude, min(amplitude, decide(env.latest)))
        env.advance(angle)
        if index >= settled:
            times.append(env.latest.time)
            thrusts.append(env.latest.fx)
            angles.append(angle)
    after = _force_at_rest(env, settings.rest, stop)
    if stop():
        return None
    (began, zero_then), (ended, zero_now) = before, after
    zero = np.interp(float(np.mean(times)), [began, ended], [zero_then, zero_now])
    shares = np.array(angles) / amplitude
    return Trial(
        thrust=float(np.mean(thrusts) - zero),
        frequency=beat_frequency(shares, tick),
        fullness=float(np.mean(np.abs(shares))),
        tick=tick,
    )


def _force_at_rest(env: SwimEnv, seconds: float, stop: Callable[[], bool]) -> tuple[float, float]:
    """When it was [s], and the mean F_x of the last third of a rest [N]; 0 for no rest."""
    times, forces = [], []
    for _ in range(math.ceil(seconds / env.link.tick)):
        if stop():
            break
        env.advance(0.0)
        times.append(env.latest.time)
        forces.append(env.latest.fx)
    if not forces:
        return env.latest.time, 0.0
    last = max(1, len(forces) // 3)
    return float(np.mean(times[-last:])), float(np.mean(forces[-last:]))


def beat_frequency(shares: NDArray[np.float64], tick: float) -> float:
    """Tail beats per second, from the changes of side of a command; 0 for less than a beat [Hz].

    shares: φ_c/Φ of successive ticks; what is too small to swim with is on neither side
    tick: [s]
    """
    sides = np.sign(shares[np.abs(shares) >= STALLED])
    reversals = int(np.count_nonzero(np.diff(sides)))
    return reversals / (2.0 * len(shares) * tick) if reversals > 1 else 0.0
