"""Evaluations without exploration: how does a policy swim, in simulation or on the robot?"""

import itertools
import math
from collections.abc import Callable

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd import simulation
from fishd.config import Config, Start
from fishd.core.signals import Observation
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.simulated_link import FunctionController, NullPublisher, at_edge
from fishd.learning.settings import EvaluationSettings, TrainingSettings
from fishd.simulation import Report

STALLED = 0.05
"""A policy whose mean |φ_c| is below this share of Φ does not swim."""
CHATTER = 0.9
"""Nor does one that reverses in more than this share of the ticks: the fin does not follow."""

SHAKE = 1.0
"""How long a fish is shaken [s]."""

Decide = Callable[[Observation], float]
"""A policy: observation in, instruction angle out [rad]."""


class Evaluation(Struct, frozen=True, kw_only=True):
    """How a policy swam without exploration; a row of evaluations.csv."""

    steps: int = 0
    """Control steps that it had learned from."""
    tank_time: float = 0.0
    """Time in the tank until then [s]."""
    thrust: float
    """Mean thrust: the true one of a simulated fish, the measured one of a robot [N]."""
    efficiency: float
    """Thrust over that of the configured fish's best square wave."""
    frequency: float
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    stalled: bool
    """It does not swim: it holds still, or nearly so, or reverses in nearly every tick."""
    worst: float | None = None
    """Lowest efficiency on this and on other fish, where others were tried."""
    best: bool = False
    """It swims, and no evaluation before was better."""

    @property
    def merit(self) -> float:
        """The figure that the best policy is chosen by."""
        return self.efficiency if self.worst is None else self.worst


def judge(
    config: Config, decide: Decide, seconds: float, settle: float, name: str = "policy"
) -> Report:
    """Let a policy swim the simulated fish of `config`, from rest, as a controller does.

    seconds, settle: as for `fishd.simulation.simulate` [s]

    Raises `ParameterError` where the lengths do not fit one another.
    """
    config = replace(config, robot="simulated", start=Start())
    controller = FunctionController(config, decide)
    return simulation.judge(config, name, controller, seconds, settle, NullPublisher())


def in_simulation(config: Config, decide: Decide, settings: EvaluationSettings) -> Evaluation:
    """Evaluate on a new fish as configured, not a randomised one, and with other noise."""
    noise = replace(config.simulation, seed=config.simulation.seed + 1)
    found = judge(replace(config, simulation=noise), decide, settings.seconds, settings.settle)
    return Evaluation(
        thrust=float(found.mean_thrust),
        efficiency=float(found.efficiency),
        frequency=float(found.frequency),
        fullness=float(found.fullness),
        stalled=_is_stalled(found.frequency, found.fullness, config.tick),
    )


def worst_of_others(config: Config, decide: Decide, settings: TrainingSettings) -> float:
    """Lowest efficiency on fish at the edges of the randomisation, each over its own optimum.

    Each begins with rapid reversals, which some policies never leave.
    """
    found = settings.evaluation
    return min(
        judge(
            at_edge(config, settings.randomisation, seed),
            _shaken(decide, config),
            found.seconds,
            found.settle,
        ).efficiency
        for seed in range(found.others)
    )


def on_link(
    env: SwimEnv, decide: Decide, settings: EvaluationSettings, stop: Callable[[], bool]
) -> Evaluation | None:
    """Evaluate on the fish that learns, by its measured thrust; None where `stop` says so.

    The tail rests before and after, so that a drift of the sensor can be subtracted. The fish must
    not be in a pause. Raises `LinkLost`.
    """
    tick, amplitude = env.link.tick, env.link.amplitude
    began, zero_then = _force_at_rest(env, settings.rest, stop)
    settled = round(settings.settle / tick)
    times, thrusts, angles = [], [], []
    for index in range(math.ceil(settings.seconds / tick)):
        if stop():
            return None
        angle = max(-amplitude, min(amplitude, decide(env.latest)))
        env.advance(angle)
        if index >= settled:
            times.append(env.latest.time)
            thrusts.append(env.latest.fx)
            angles.append(angle)
    ended, zero_now = _force_at_rest(env, settings.rest, stop)
    if stop():
        return None
    zero = np.interp(float(np.mean(times)), [began, ended], [zero_then, zero_now])
    thrust = float(np.mean(thrusts) - zero)
    shares = np.array(angles) / amplitude
    frequency, fullness = beat_frequency(shares, tick), float(np.mean(np.abs(shares)))
    return Evaluation(
        thrust=thrust,
        efficiency=thrust / env.best_thrust,
        frequency=frequency,
        fullness=fullness,
        stalled=_is_stalled(frequency, fullness, tick),
    )


def beat_frequency(shares: NDArray[np.float64], tick: float) -> float:
    """Tail beats per second, from a command's changes of side; 0 for less than a beat [Hz].

    shares: φ_c/Φ of successive ticks; what is too small to swim with is on neither side
    tick: [s]
    """
    sides = np.sign(shares[np.abs(shares) >= STALLED])
    reversals = int(np.count_nonzero(np.diff(sides)))
    return reversals / (2.0 * len(shares) * tick) if reversals > 1 else 0.0


def _is_stalled(frequency: float, fullness: float, tick: float) -> bool:
    return frequency == 0.0 or fullness < STALLED or 2.0 * frequency * tick > CHATTER


def _shaken(decide: Decide, config: Config) -> Decide:
    """Reverse in every tick at first, and decide only then."""
    ticks = itertools.count()

    def decided(observation: Observation) -> float:
        tick = next(ticks)
        if tick * config.tick < SHAKE:
            return config.amplitude_limit * (-1.0) ** tick
        return decide(observation)

    return decided


def _force_at_rest(env: SwimEnv, seconds: float, stop: Callable[[], bool]) -> tuple[float, float]:
    """Mean time [s] and mean F_x [N] of the last third of a rest; a force of 0 for no rest."""
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
