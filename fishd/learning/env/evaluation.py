"""Evaluations without exploration, of a simulated fish; those in a tank are made of `swims`."""

import itertools
from collections.abc import Callable

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.camera.simulated.sight import SimulatedSight
from fishd.config import Config, Start
from fishd.controllers.dwell import DwellLimit
from fishd.core.camera_frames import Stack
from fishd.core.signals import Observation
from fishd.lab import simulation
from fishd.lab.simulation import Report, VirtualRun
from fishd.learning.env.simulated_link import (
    Camera,
    FunctionController,
    at_edge,
    drawn,
)
from fishd.learning.settings import EvaluationSettings, TrainingSettings

STALLED = 0.05
"""A policy whose mean |φ_c| is below this share of Φ does not swim."""
CHATTER = 0.9
"""Nor does one that reverses in more than this share of the ticks: the fin does not follow."""

SHAKE = 1.0
"""How long a fish is shaken [s]."""

Decide = Callable[[Observation, Stack | None], float]
"""A policy: observation, and frames where it sees any, in; instruction angle out [rad]."""


class Evaluation(Struct, frozen=True, kw_only=True):
    """How a policy swam without exploration; a row of evaluations.csv."""

    steps: int = 0
    """Control steps that the training had learned from."""
    policy: int = 0
    """Control steps that the policy had learned from which swam: in a tank, it may be older."""
    tank_time: float = 0.0
    """Time in the tank until then [s]."""
    swam: float | None = None
    """How long this policy has swum in the tank in all its evaluations [s]; None in simulation."""
    thrust: float
    """Mean thrust: the true one of a simulated fish, the mean of all swims in a tank [N].

    In a tank it is 0 where the policy stalled.
    """
    error: float | None = None
    """Half of the 95 % interval of a measured thrust [N]; a true one needs none."""
    relative_thrust: float
    """Thrust over that of the configured fish's best square wave."""
    frequency: float
    """Tail beats per second; 0 where the tail does not beat [Hz]."""
    fullness: float
    """Mean |φ_c|/Φ."""
    stalled: bool
    """It does not swim: it holds still, or nearly so, or reverses in nearly every tick."""
    worst: float | None = None
    """Lowest relative thrust on this and on other fish, where others were tried."""
    best: bool = False
    """It swims, and is the best so far."""

    @property
    def merit(self) -> float:
        """The figure that the best policy is chosen by."""
        return self.relative_thrust if self.worst is None else self.worst


def judge(
    config: Config,
    decide: Decide,
    seconds: float,
    settle: float,
    camera: Camera | None = None,
) -> Report:
    """Let a policy swim the simulated fish of `config`, from rest, as a controller does.

    seconds, settle: as for `fishd.lab.simulation.simulate` [s]
    camera: what it sees the fish with, if it sees any

    Raises `ParameterError` where the lengths do not fit one another.
    """
    config = replace(config, robot="simulated", start=Start())
    sights: list[SimulatedSight] = []

    def begun(run: VirtualRun) -> None:
        if camera and run.loop.robot.truth:
            sights.append(camera.on(run.loop.robot.truth, config.tick))

    def decided(seen: Observation) -> float:
        return decide(seen, sights[0].look(seen.time) if sights else None)

    controller = FunctionController(config, decided)
    return simulation.judge(config, "policy", controller, seconds, settle, None, begun)


def in_simulation(
    config: Config, decide: Decide, settings: EvaluationSettings, camera: Camera | None = None
) -> Evaluation:
    """Evaluate on a new fish as configured, not a randomised one, and with other noise."""
    noise = replace(config.simulation, seed=config.simulation.seed + 1)
    if camera:
        light = replace(camera.settings, seed=camera.settings.seed + 1)
        camera = replace(camera, settings=light)
    found = judge(
        replace(config, simulation=noise), decide, settings.seconds, settings.settle, camera
    )
    return Evaluation(
        thrust=float(found.mean_thrust),
        relative_thrust=float(found.relative_thrust),
        frequency=float(found.frequency),
        fullness=float(found.fullness),
        stalled=is_stalled(found.frequency, found.fullness, config.tick),
    )


def worst_of_others(
    config: Config, decide: Decide, settings: TrainingSettings, camera: Camera | None = None
) -> float:
    """Lowest relative thrust on fish of the randomisation, each over its own optimum.

    At the edges each begins with rapid reversals, which some policies never leave. In the range
    they swim as `ppo` does, with the shortest dwell; who insists on less counts as worth nothing.
    """
    swim = _at_edge if settings.evaluation.others_from == "edges" else _in_range
    seeds = range(settings.evaluation.others)
    return min(swim(config, decide, settings, camera, seed) for seed in seeds)


def _at_edge(
    config: Config,
    decide: Decide,
    settings: TrainingSettings,
    camera: Camera | None,
    seed: int,
) -> float:
    fish, found = at_edge(config, settings.randomisation, seed), settings.evaluation
    return judge(fish, _shaken(decide, config), found.seconds, found.settle, camera).relative_thrust


def _in_range(
    config: Config,
    decide: Decide,
    settings: TrainingSettings,
    camera: Camera | None,
    seed: int,
) -> float:
    fish, found = drawn(config, settings.randomisation, seed), settings.evaluation
    limits = fish.limits
    limit = DwellLimit(limits.dwell, limits, fish.amplitude_limit)

    def limited(observation: Observation, stack: Stack | None) -> float:
        return limit.apply(decide(observation, stack), observation.dt)

    report = judge(fish, limited, found.seconds, found.settle, camera)
    return 0.0 if report.fallback else report.relative_thrust


def beat_frequency(shares: NDArray[np.float64], tick: float) -> float:
    """Tail beats per second, from a command's changes of side; 0 for less than a beat [Hz].

    shares: φ_c/Φ of successive ticks; what is too small to swim with is on neither side
    tick: [s]
    """
    sides = np.sign(shares[np.abs(shares) >= STALLED])
    reversals = int(np.count_nonzero(np.diff(sides)))
    return reversals / (2.0 * len(shares) * tick) if reversals > 1 else 0.0


def is_stalled(frequency: float, fullness: float, tick: float) -> bool:
    """Does a policy that beats so often [Hz] and so fully not swim? tick: period of the loop [s]"""
    return frequency == 0.0 or fullness < STALLED or 2.0 * frequency * tick > CHATTER


def _shaken(decide: Decide, config: Config) -> Decide:
    """Reverse in every tick at first, and decide only then."""
    ticks = itertools.count()

    def decided(observation: Observation, stack: Stack | None) -> float:
        tick = next(ticks)
        if tick * config.tick < SHAKE:
            return config.amplitude_limit * (-1.0) ** tick
        return decide(observation, stack)

    return decided
