"""The rollouts that PPO learns from: exploration, void steps, figures for the log, pause and stop.

They equal those of stable-baselines3 for a single environment, but the networks are computed once
for all steps of a rollout: torch takes far longer for a single input than the fish for a tick.
"""

from collections.abc import Callable
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO

from fishd.learning.env.environment import SwimEnv, Vector
from fishd.learning.env.evaluation import beat_frequency
from fishd.learning.links.link import LinkLost
from fishd.learning.ppo import MeanAction, Rollout
from fishd.learning.train.progress import Display


class Rollouts:
    """A collector that fills the buffer of a PPO, one rollout at a time, and logs the swimming."""

    def __init__(
        self, model: PPO, env: SwimEnv, display: Display, stop: Callable[[], bool]
    ) -> None:
        """stop: called after each step; True ends the rollout there"""
        self._model, self._env, self._display, self._stop = model, env, display, stop
        self._buffer = cast(Rollout, model.rollout_buffer)
        self._observation: Vector
        self._starts = True
        self._lost = self._blind = 0
        """Numbers of lost and of blind ticks of the environment until the last rollout ended."""
        self.dropped = 0
        """Number of steps of a rollout that was stopped midway, not used for learning."""

    def begin(self, observation: Vector) -> None:
        """Begin an episode with the observation for the next step."""
        self._observation, self._starts = observation, True

    def collect(self) -> bool:
        """Explore for one rollout, and pause the fish; False where it was stopped midway.

        Raises `LinkLost`, also where most steps were void.
        """
        buffer, env, model = self._buffer, self._env, self._model
        buffer.reset()
        steps = buffer.buffer_size
        mean = MeanAction(model.policy)
        deviation = model.policy.log_std.detach().exp()
        noise = (torch.randn(steps, 1) * deviation)[:, 0].tolist()
        ends: dict[int, Vector] = {}
        paused = 0.0
        for step in range(steps):
            buffer.observations[step, 0] = self._observation
            buffer.episode_starts[step, 0] = self._starts
            action = mean(self._observation) + noise[step]
            buffer.actions[step, 0, 0] = action
            clipped = np.array((min(1.0, max(-1.0, action)),), np.float32)
            self._observation, reward, _, self._starts, info = env.step(clipped)
            buffer.rewards[step, 0] = reward
            buffer.forces[step] = info["thrust"], info["lateral_force"]
            buffer.void[step] = info["lost"] + info["blind"] > 0
            paused += info["paused"]
            self._display.step(env.tank_time)
            if self._stop():
                self.dropped = step + 1
                return False
            if self._starts:
                ends[step] = self._observation
                self._observation, _ = env.reset()
        env.pause()
        buffer.pos, buffer.full = steps, True
        self._log(paused)
        self._complete(ends)
        return True

    def _complete(self, ends: dict[int, Vector]) -> None:
        """Add the values and log probabilities of its steps to the buffer.

        ends: last observation of each truncated episode, by its step
        """
        buffer, policy = self._buffer, self._model.policy
        policy.set_training_mode(False)
        last = np.array([*ends.values(), self._observation], np.float32)
        with torch.no_grad():
            values, log_probabilities, _ = policy.evaluate_actions(
                torch.from_numpy(buffer.observations[:, 0]), torch.from_numpy(buffer.actions[:, 0])
            )
            *of_ends, following = policy.predict_values(torch.from_numpy(last))
        buffer.values[:] = values.numpy()
        buffer.log_probs[:, 0] = log_probabilities.numpy()
        for step, value in zip(ends, of_ends, strict=True):
            buffer.rewards[step] += buffer.gamma * value.numpy()
        buffer.compute_returns_and_advantage(following, np.array([self._starts]))

    def _log(self, paused: float) -> None:
        """Log how the fish swam; raise `LinkLost` where most steps were void.

        paused: waiting time at neutral before and between the steps [s]
        """
        buffer, env = self._buffer, self._env
        lost, blind = env.lost - self._lost, env.blind - self._blind
        steps = buffer.buffer_size
        if np.count_nonzero(buffer.void) > steps // 2:
            if blind > lost:
                raise LinkLost(
                    f"in most of the last {steps} steps the camera has shown no whole stack of "
                    "frames: they come too seldom or too late for camera.stack; give that a larger "
                    "delay or oldest, or the camera a higher rate"
                )
            raise LinkLost(
                f"in most of the last {steps} steps the agent's action came too late for its tick; "
                "run it on a faster or less busy machine, nearer to fishd"
            )
        actions: NDArray[np.float64] = np.clip(buffer.actions[:, 0, 0], -1.0, 1.0)
        thrust = float(buffer.forces[:, 0].mean())
        relative_thrust = thrust / env.best_thrust
        frequency = beat_frequency(actions, env.link.tick)
        for name, value in (
            ("tank/lost_ticks", lost),
            ("tank/blind_ticks", blind),
            ("tank/paused", paused),
            ("rollout/reward", float(buffer.rewards.mean())),
            ("rollout/thrust", thrust),
            ("rollout/relative_thrust", relative_thrust),
            ("rollout/frequency", frequency),
            ("rollout/fullness", float(np.mean(np.abs(actions)))),
        ):
            self._model.logger.record(name, value)
        self._lost, self._blind = env.lost, env.blind
        self._display.explored(thrust, relative_thrust, frequency)
