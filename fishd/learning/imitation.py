"""Learning from the best square wave of each fish, before PPO begins or in its place.

The number of ticks of the best half beat of a simulated fish is known. So the learner swims many
fish, each tick is labelled with the side that would be right there, and the network is fitted to
the labels of all previous rounds (DAgger: Ross, Gordon and Bagnell 2011). The identity of the fish
is not an input: the network can only infer it from its history. Many fish look nearly alike and
need different beats, so their distribution matters: some are drawn from a random share of the
randomisation, so that fish like the configured one are common.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from msgspec.structs import replace
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.nn.functional import softplus

from fishd.config import Config
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.fish_variation import draw_fish
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.ppo import DeterministicPolicy
from fishd.learning.settings import ImitationSettings, Randomisation, TrainingSettings
from fishd.virtual.plant.optimum import square_wave
from fishd.virtual.plant.parameters import PlantParameters

MAX_HALF_BEAT_S = 1.2
"""Longest half beat that is compared [s]."""
RANDOM_START_RATIO = 3
"""Smallest ratio of all ticks of a fish to its initial ticks, which are swum by random waves."""
NARROWED_SHARE = 0.3
"""Share of the fish that are from a part of the randomisation; the others are from all of it."""
RIG_RANGES = ("servo_delay", "servo_dead_zone", "backlash", "servo_reaction", "cable_slack")
"""Names of the ranges of a randomisation that are smaller for a clean rig."""
SLOW_PLACES = -1.0, -0.3
"""Lowest and highest place of ω₀ and ξ of slow fish in their ranges, from -1 to 1."""
MIN_WEIGHT = 0.02
"""Weight of a tick in which both sides are equally good, as a share of the best thrust."""


class LabelledTicks(NamedTuple):
    """Ticks, labelled with the right side of each."""

    seen: NDArray[np.float32]
    """Inputs of the network, shape (ticks, inputs)."""
    sides: NDArray[np.float32]
    """Right side, 1 or -1, shape (ticks,)."""
    weights: NDArray[np.float32]
    """Cost of the choice of the other side, shape (ticks,)."""


def narrow(spread: Randomisation, share: float, rig_share: float = 1.0) -> Randomisation:
    """Return a randomisation with narrower ranges.

    share: factor on each range, from 0 to 1
    rig_share: further factor on the ranges in `RIG_RANGES`, the effects of the rig
    """
    names = [name for name in Randomisation.__struct_fields__ if name != "fish"]
    ranges = {name: share * getattr(spread, name) for name in names}
    return replace(spread, **ranges | {name: rig_share * ranges[name] for name in RIG_RANGES})


def slow_down(
    fish: Config, nominal: PlantParameters, spread: Randomisation, draw: np.random.Generator
) -> Config:
    """Return a fish with another ω₀ and ξ, from the lower third of their ranges.

    nominal: fish in the middle of the ranges
    """
    omega0, xi = (
        float(getattr(nominal, name) * (1.0 + getattr(spread, name)) ** place)
        for name, place in zip(("omega0", "xi"), draw.uniform(*SLOW_PLACES, 2), strict=True)
    )
    return replace(fish, plant=replace(fish.plant, omega0=omega0, xi=xi))


def half_beat_thrusts(config: Config) -> NDArray[np.float64]:
    """Return the relative thrust of square waves by ticks of half a beat; that of 0 ticks is 0."""
    return _half_beat_thrusts(config.plant, config.amplitude_limit, config.tick)


@lru_cache(maxsize=64)  # a fish of a list is drawn again and again
def _half_beat_thrusts(
    plant: PlantParameters, amplitude: float, tick: float
) -> NDArray[np.float64]:
    ticks = range(1, math.ceil(MAX_HALF_BEAT_S / tick) + 1)
    thrusts = [square_wave(plant, amplitude, 0.5 / (n * tick)).thrust for n in ticks]
    return np.array([0.0, *thrusts]) / max(thrusts)


class Imitation:
    """Imitation learning of a policy from the best waves of many simulated fish."""

    def __init__(
        self, config: Config, settings: TrainingSettings, policy: ActorCriticPolicy
    ) -> None:
        """policy: trained in place

        Raises `ConfigError` as `SwimEnv` does.
        """
        self._config = config
        self._settings: ImitationSettings = settings.imitation
        self._environment = replace(settings.seen, own_fish=False)
        self._spread = settings.randomisation
        self._policy = policy
        self._draw = np.random.default_rng([settings.seed, 1])
        self._rounds: list[LabelledTicks] = []

    def round(self, stop: Callable[[], bool] = lambda: False) -> float | None:
        """Swim with new fish, and learn from them and from all previous fish.

        stop: called after each fish; True ends it

        Returns the share of right sides, weighted by cost; None where it was stopped.
        """
        fish = []
        for _ in range(self._settings.fish):
            if stop():
                return None
            fish.append(self._swim_fish())
        self._rounds.append(_join(fish))
        return self._fit(_join(self._rounds))

    def _swim_fish(self) -> LabelledTicks:
        """Swim one fish: first random half beats, then, after the first round, the learner."""
        config, draw, ticks = self._config, self._draw, self._settings.ticks
        fish = self._draw_fish()
        env = SwimEnv(SimulatedLink(fish), config, self._environment)
        seen, _ = env.reset(seed=int(draw.integers(2**31)))
        learner = DeterministicPolicy(self._policy, env.perception, env.link.amplitude)
        relative_thrust = half_beat_thrusts(fish)
        at_random = int(draw.integers(ticks // RANDOM_START_RATIO + 1)) if self._rounds else ticks
        longest = 2 * int(relative_thrust.argmax())
        half = int(draw.integers(2, longest + 2))
        rows, sides, weights = [], [], []
        for tick in range(ticks):
            side = math.copysign(1.0, env.latest.side_time)
            elapsed = round(abs(env.latest.side_time) / config.tick)
            right, weight = advise_side(relative_thrust, elapsed)
            rows.append(seen)
            sides.append(float(right) * side)
            weights.append(float(weight))
            share = learner(env.latest) / config.amplitude_limit
            if tick < at_random:
                share = -side if elapsed >= half else side
                half = half if elapsed < half else int(draw.integers(2, longest + 2))
            seen = env.step(np.full(1, share, np.float32))[0]
        return LabelledTicks(np.array(rows), *np.array((sides, weights), np.float32))

    def _draw_fish(self) -> Config:
        """Return a fish and rig of the randomisation; some are from a part of it."""
        settings, draw, spread = self._settings, self._draw, self._spread
        share = min(1.0, float(draw.uniform()) / NARROWED_SHARE)
        is_clean = settings.clean_rigs > 0.0 and draw.uniform() < settings.clean_rigs
        narrowed = narrow(spread, share, float(draw.uniform()) if is_clean else 1.0)
        fish = draw_fish(self._config, narrowed, int(draw.integers(2**31)))
        if settings.slow_fish == 0.0 or draw.uniform() >= settings.slow_fish:
            return fish
        return slow_down(fish, self._config.plant, spread, draw)

    def _fit(self, given: LabelledTicks) -> float:
        """Fit the network to all ticks from a high learning rate to a low one."""
        settings = self._settings
        optimiser = torch.optim.Adam(self._policy.parameters(), settings.learning_rate)
        batches = settings.epochs * math.ceil(len(given.seen) / settings.batch_size)
        rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, batches)
        return self._learn(given, optimiser, rate.step)

    def _learn(
        self,
        given: LabelledTicks,
        optimiser: torch.optim.Adam,
        after_batch: Callable[[], None] = lambda: None,
    ) -> float:
        """Pass over the ticks `epochs` times; return the weighted share of right sides."""
        settings, policy = self._settings, self._policy
        seen, sides, weights = (torch.from_numpy(array) for array in given)
        weights = weights / weights.sum()
        batches = math.ceil(len(seen) / settings.batch_size)
        share = 0.0
        for _ in range(settings.epochs):
            share = 0.0
            for batch in torch.from_numpy(self._draw.permutation(len(seen))).chunk(batches):
                good = sides[batch] * policy.get_distribution(seen[batch]).mode()[:, 0]
                loss = batches * (weights[batch] * softplus(-good)).sum()
                optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
                after_batch()
                share += float((weights[batch] * (good > 0.0)).sum())
        return share


def advise_side(
    relative_thrust: NDArray[np.float64], elapsed: NDArray[np.int64] | int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return 1 to stay or -1 to reverse, and the cost of the other choice, for one fish or many.

    relative_thrust: as returned by `half_beat_thrusts`, shape (..., ticks)
    elapsed: ticks since the last reversal, shape (...)
    """
    now = np.minimum(elapsed, relative_thrust.shape[-1] - 2)
    places = np.stack((now, now + 1), axis=-1)
    stay, wait = np.moveaxis(np.take_along_axis(relative_thrust, places, axis=-1), -1, 0)
    cost = np.abs(stay - wait) + MIN_WEIGHT
    return np.where(now >= relative_thrust.argmax(axis=-1), -1.0, 1.0), cost


def _join(parts: list[LabelledTicks]) -> LabelledTicks:
    return LabelledTicks(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
