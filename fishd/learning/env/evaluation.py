"""Evaluations without exploration on a simulated fish; `swims` has those in a tank."""

import itertools
import math
from collections.abc import Callable

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.camera.simulated import SimulatedSight
from fishd.config import Config, Start
from fishd.controllers.dwell import DwellLimit
from fishd.core.camera_frames import Stack
from fishd.core.signals import Observation
from fishd.lab import simulation
from fishd.lab.simulation import Report, VirtualRun
from fishd.learning.env.fish_variation import draw_edge_fish, draw_fish
from fishd.learning.links.simulated_link import Camera, FunctionController
from fishd.learning.settings import EvaluationSettings, TrainingSettings

MIN_FULLNESS = 0.05
"""Smallest mean |φ_c|/Φ of a policy that swims."""
MAX_REVERSAL_SHARE = 0.9
"""Largest share of ticks with a reversal of a policy that swims: the fin cannot follow more."""

SHAKE_TIME_S = 1.0
"""Time of rapid reversals at the start of a swim [s]."""

Decide = Callable[[Observation, Stack | None], float]
"""A policy: returns the instruction angle [rad] for an observation and frames, if it sees any."""


class Evaluation(Struct, frozen=True, kw_only=True):
    """The result of a policy without exploration; a row of evaluations.csv."""

    steps: int = 0
    """Number of control steps that the training had learned from."""
    policy: int = 0
    """Number of control steps that this policy had learned from; in a tank, it may be older."""
    tank_time: float = 0.0
    """Time in the tank until the evaluation [s]."""
    swim_time: float | None = None
    """Time that this policy has swum in all its evaluations [s]; None in simulation."""
    thrust: float
    """Mean thrust [N]: the true one of a simulated fish, the mean of all swims in a tank.

    In a tank it is 0 if the policy stalled.
    """
    thrust_ci95: float | None = None
    """Half-width of the 95 % interval of a measured thrust [N]; None for a true one."""
    relative_thrust: float
    """Thrust relative to the best square wave of the configured fish."""
    frequency: float
    """Tail-beat frequency; 0 where the tail does not beat [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    is_stalled: bool
    """Whether the policy does not swim: it hardly moves, or reverses in nearly every tick."""
    lowest_relative_thrust: float | None = None
    """Lowest relative thrust on this and on other fish; None if others were not tried."""
    best: bool = False
    """Whether the policy swims, and is the best until now."""

    @property
    def merit(self) -> float:
        """Figure by which the best policy is chosen."""
        return (
            self.relative_thrust
            if self.lowest_relative_thrust is None
            else self.lowest_relative_thrust
        )


def judge(
    config: Config,
    decide: Decide,
    seconds: float,
    settle: float,
    camera: Camera | None = None,
) -> Report:
    """Return the report of a swim of a policy, from rest, on the simulated fish of `config`.

    seconds, settle: lengths as for `fishd.lab.simulation.simulate` [s]
    camera: camera of a policy that sees pictures

    Raises `ParameterError` where the lengths do not agree.
    """
    config = replace(config, robot="simulated", start=Start())
    sights: list[SimulatedSight] = []

    def attach_camera(run: VirtualRun) -> None:
        if camera and run.loop.robot.truth:
            sights.append(camera.make_sight(run.loop.robot.truth, config.tick))

    def decide_with_frames(observation: Observation) -> float:
        return decide(observation, sights[0].look(observation.time) if sights else None)

    controller = FunctionController(config, decide_with_frames)
    return simulation.judge(config, "policy", controller, seconds, settle, None, attach_camera)


def evaluate_in_simulation(
    config: Config, decide: Decide, settings: EvaluationSettings, camera: Camera | None = None
) -> Evaluation:
    """Return the evaluation on the configured fish, not a randomised one, with other noise."""
    noise = replace(config.simulation, seed=config.simulation.seed + 1)
    if camera:
        light = replace(camera.settings, seed=camera.settings.seed + 1)
        camera = replace(camera, settings=light)
    report = judge(
        replace(config, simulation=noise), decide, settings.seconds, settings.settle, camera
    )
    return Evaluation(
        thrust=float(report.mean_thrust),
        relative_thrust=float(report.relative_thrust),
        frequency=float(report.frequency),
        fullness=float(report.fullness),
        is_stalled=is_stalled(report.frequency, report.fullness, config.tick),
    )


def worst_on_others(
    config: Config, decide: Decide, settings: TrainingSettings, camera: Camera | None = None
) -> float:
    """Return the lowest relative thrust on fish of the randomisation, each over its own optimum.

    At the edges each swim begins with rapid reversals, which some policies never leave. In the
    range policies swim as in `ppo`, with the shortest dwell; the relative thrust of a policy that
    continues to reverse faster is 0.
    """
    lengths, spread = settings.evaluation, settings.randomisation
    lowest = math.inf
    for seed in range(lengths.others):
        if lengths.others_from == "edges":
            fish, swim = draw_edge_fish(config, spread, seed), _shake_first(decide, config)
        else:
            fish = draw_fish(config, spread, seed)
            swim = _limit_dwell(decide, fish)
        report = judge(fish, swim, lengths.seconds, lengths.settle, camera)
        lowest = min(lowest, 0.0 if report.fallback else report.relative_thrust)
    return lowest


def _limit_dwell(decide: Decide, fish: Config) -> Decide:
    """Return a policy with the shortest dwell of a fish, as in `ppo`."""
    limit = DwellLimit(fish.limits.dwell, fish.limits, fish.amplitude_limit)

    def decide_limited(observation: Observation, stack: Stack | None) -> float:
        return limit.apply(decide(observation, stack), observation.dt)

    return decide_limited


def beat_frequency(shares: NDArray[np.float64], tick: float) -> float:
    """Return the tail-beat frequency from the reversals of a command; 0 for less than a beat [Hz].

    shares: φ_c/Φ of successive ticks; values below `MIN_FULLNESS` are on neither side
    tick: period of the loop [s]
    """
    sides = np.sign(shares[np.abs(shares) >= MIN_FULLNESS])
    reversals = int(np.count_nonzero(np.diff(sides)))
    return reversals / (2.0 * len(shares) * tick) if reversals > 1 else 0.0


def is_stalled(frequency: float, fullness: float, tick: float) -> bool:
    """Return whether a policy does not swim.

    frequency: tail-beat frequency [Hz]
    fullness: mean |φ_c|/Φ
    tick: period of the loop [s]
    """
    return (
        frequency == 0.0 or fullness < MIN_FULLNESS or 2.0 * frequency * tick > MAX_REVERSAL_SHARE
    )


def _shake_first(decide: Decide, config: Config) -> Decide:
    """Return a policy that reverses in every tick for `SHAKE_TIME_S`, then decides as given."""
    ticks = itertools.count()

    def decide_later(observation: Observation, stack: Stack | None) -> float:
        tick = next(ticks)
        if tick * config.tick < SHAKE_TIME_S:
            return config.amplitude_limit * (-1.0) ** tick
        return decide(observation, stack)

    return decide_later
