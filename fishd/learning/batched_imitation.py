"""Imitation learning from thousands of fish that swim at once.

Each round has new fish and ends with a pass over their ticks, so the network never learns a fish by
heart. `Imitation` keeps all ticks instead, as its fish are few.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from fishd.config import Config
from fishd.core.signals import MAX_SIDE_TIME_S
from fishd.learning.env.environment import features
from fishd.learning.imitation import MAX_HALF_BEAT_S, Imitation, LabelledTicks, advise_side
from fishd.learning.settings import TrainingSettings
from fishd.virtual.plant.batch import Array, FishBatch

RANDOM_FISH_FRACTION = 0.15
"""Fraction of the fish that only swim random half beats."""
MAX_SERIES_RATE = 0.12
"""Highest probability of a reversal of the learner that begins a series of random half beats."""
MAX_SERIES = 6
"""Largest number of half beats in such a series."""
WIDE_FRACTION = 0.3
"""Fraction of the random half beats that are of any length, the others being near the best one."""
NEAR_TICKS = 2
"""Largest distance of a random half beat near the best one [ticks]; also that of the ticks of which
more are kept."""
KEPT_NEAR, KEPT_FAR = 0.8, 0.15
"""Fractions of the ticks that the network learns from, near the best reversal and far from it."""


class BatchedImitation(Imitation):
    """Imitation learning of a policy from the best waves of batches of simulated fish."""

    def __init__(
        self, config: Config, settings: TrainingSettings, policy: ActorCriticPolicy
    ) -> None:
        """policy: trained in place"""
        super().__init__(config, settings, policy)
        self._features = features(config, self._environment)
        self._optimiser = torch.optim.Adam(policy.parameters(), self._settings.learning_rate)
        self._rate = torch.optim.lr_scheduler.CosineAnnealingLR(
            self._optimiser, self._settings.rounds
        )

    def round(self, stop: Callable[[], bool] = lambda: False) -> float | None:
        """Swim with new fish, and learn from them; see `Imitation.round`."""
        ticks = self._swim(stop)
        if ticks is None:
            return None
        right = self._learn(ticks, self._optimiser)
        self._rate.step()
        return right

    def _swim(self, stop: Callable[[], bool]) -> LabelledTicks | None:
        """Swim all fish; return some of their ticks, or None where it was stopped."""
        config, draw, count = self._config, self._draw, self._settings.fish
        fish = [self._draw_fish() for _ in range(count)]
        batch = FishBatch([one.plant for one in fish], config.tick)
        longest = math.ceil(MAX_HALF_BEAT_S / config.tick)
        thrusts = batch.half_beat_thrusts(config.amplitude_limit, longest)
        thrusts = np.maximum(thrusts, 0.0) / thrusts.max(axis=1, keepdims=True)
        best = thrusts.argmax(axis=1)
        sensor = _Sensor(fish, self._spread.offset, draw)
        waves = _RandomWaves(best, draw)
        first = draw.integers(self._environment.longest_start + 1, size=count)
        start = draw.uniform(-1.0, 1.0, count)
        shape = (count, self._environment.history, len(self._features))
        history = np.zeros(shape, np.float32)
        side, elapsed = np.ones(count), np.zeros(count, int)
        action = previous = np.zeros(count)
        parts = []
        for tick in range(self._settings.ticks):
            if stop():
                return None
            fx, fy = sensor.read(*batch.advance(config.amplitude_limit * action))
            values = {
                "fx": fx,
                "fy": fy,
                "instruction_angle": config.amplitude_limit * action,
                "previous_angle": config.amplitude_limit * previous,
                "side_time": side * np.minimum(elapsed * config.tick, MAX_SIDE_TIME_S),
            }
            row = [values[feature.name] / feature.scale for feature in self._features]
            history[:, 1:] = history[:, :-1].copy()
            history[:, 0] = np.stack(row, axis=-1)
            if tick == 0:
                history[:] = history[:, :1]
            right, weights = advise_side(thrusts, elapsed)
            kept = np.where(np.abs(elapsed + 0.5 - best) <= NEAR_TICKS, KEPT_NEAR, KEPT_FAR)
            rows = draw.uniform(size=count) < kept
            seen = history.reshape(count, -1)
            parts.append((seen[rows], (right * side)[rows], (weights / kept)[rows]))
            previous = action
            action = np.where(tick < first, start, waves.replace(self._choose(seen), side, elapsed))
            reversed_now = action * side < 0.0
            waves.note(reversed_now)
            side = np.where(reversed_now, -side, side)
            elapsed = np.where(reversed_now, 1, elapsed + 1)
        seen, sides, weights = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return LabelledTicks(seen, sides.astype(np.float32), weights.astype(np.float32))

    def _choose(self, seen: NDArray[np.float32]) -> Array:
        """Return the actions of the learner."""
        with torch.no_grad():
            actions = self._policy.get_distribution(torch.from_numpy(seen)).mode()[:, 0]
        return np.clip(actions.numpy().astype(np.float64), -1.0, 1.0)


class _Sensor:
    """Force sensors of a batch of rigs: rotated, with offsets and white noise."""

    def __init__(self, fish: Sequence[Config], offset: float, draw: np.random.Generator) -> None:
        """offset: largest difference of the offset of F_x from the configured one [N]"""
        rigs = [one.simulation for one in fish]
        rotation = np.array([rig.rotation for rig in rigs])
        self._cos, self._sin = np.cos(rotation), np.sin(rotation)
        self._noise = np.array([rig.noise for rig in rigs])
        self._offset_x = np.array([rig.offset_x for rig in rigs])
        self._offset_x += offset * draw.uniform(-1.0, 1.0, len(rigs))
        self._offset_y = np.array([rig.offset_y for rig in rigs])
        self._draw = draw

    def read(self, fx: Array, fy: Array) -> tuple[Array, Array]:
        """Return the measured forces of a tick for the true ones [N]."""
        noise_x, noise_y = self._noise * self._draw.normal(size=(2, len(fx)))
        measured_x = self._cos * fx - self._sin * fy + self._offset_x + noise_x
        return measured_x, self._sin * fx + self._cos * fy + self._offset_y + noise_y


class _RandomWaves:
    """Series of random half beats, which some fish begin at a reversal of the learner.

    They show the learner the states that its own errors lead to.
    """

    def __init__(self, best: NDArray[np.int64], draw: np.random.Generator) -> None:
        """best: half beat of the best square wave of each fish [ticks]"""
        count = len(best)
        self._best, self._draw = best, draw
        always = draw.uniform(size=count) < RANDOM_FISH_FRACTION
        self._rate = np.where(always, 1.0, draw.uniform(0.0, MAX_SERIES_RATE, count))
        self._left = np.where(
            draw.uniform(size=count) < 0.5, draw.integers(1, MAX_SERIES + 1, count), 0
        )
        """Half beats until the end of the series; 0 outside of one."""
        self._half_beat = self._draw_half_beats()

    def replace(self, actions: Array, side: Array, elapsed: NDArray[np.int64]) -> Array:
        """Return the actions of the learner, with those of the series in their place."""
        ordered = np.where(elapsed >= self._half_beat, -side, side)
        return np.where(self._left > 0, ordered, actions)

    def note(self, reversed_now: NDArray[np.bool_]) -> None:
        """Take in which fish reverse in this tick."""
        draw, count = self._draw, len(self._best)
        self._left -= reversed_now & (self._left > 0)
        begins = reversed_now & (self._left == 0) & (draw.uniform(size=count) < self._rate)
        self._left = np.where(begins, draw.integers(1, MAX_SERIES + 1, count), self._left)
        changes = begins | (reversed_now & (draw.uniform(size=count) < 0.2))
        self._half_beat = np.where(changes, self._draw_half_beats(), self._half_beat)

    def _draw_half_beats(self) -> NDArray[np.int64]:
        draw, best = self._draw, self._best
        near = best + draw.integers(-NEAR_TICKS, NEAR_TICKS + 1, len(best))
        wide = draw.integers(2, 2 * best + 2)
        is_wide = draw.uniform(size=len(best)) < WIDE_FRACTION
        return np.where(is_wide, wide, np.maximum(near, 2))
