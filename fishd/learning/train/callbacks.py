"""What happens in each rollout besides PPO: void steps, figures for the log, pause and stop."""

from collections.abc import Callable

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import beat_frequency
from fishd.learning.env.link import LinkLost
from fishd.learning.ppo import Rollout
from fishd.learning.train.progress import Display


class RolloutCallback(BaseCallback):
    """Follows each rollout step by step, pauses the fish at its end, and logs how it swam."""

    def __init__(self, env: SwimEnv, display: Display, stop: Callable[[], bool]) -> None:
        """stop: called after each step; True ends the rollout there"""
        super().__init__()
        self._env = env
        self._display = display
        self._stop = stop
        self.stopped = False
        """Was the latest rollout stopped early? Then nothing was learned from it."""
        self._lost = self._blind = 0
        """Ticks that the environment had lost, and not seen, until the previous rollout ended."""
        self._on_rollout_start()

    @property
    def steps(self) -> int:
        """Steps of the latest rollout so far."""
        return len(self._actions)

    def _on_rollout_start(self) -> None:
        self._rewards: list[float] = []
        self._thrusts: list[float] = []
        self._actions: list[float] = []
        self._paused = 0.0

    def _on_step(self) -> bool:
        buffer, info = self._buffer, self.locals["infos"][0]
        self._rewards.append(float(self.locals["rewards"][0]))
        self._thrusts.append(info["thrust"])
        self._actions.append(float(self.locals["clipped_actions"][0, 0]))
        self._paused += info["paused"]
        buffer.forces[buffer.pos] = info["thrust"], info["lateral_force"]
        buffer.void[buffer.pos] = info["lost"] + info["blind"] > 0  # where this step is stored
        self._display.step(self._env.tank_time)
        self.stopped = self._stop()
        return not self.stopped

    def _on_rollout_end(self) -> None:
        self._env.pause()
        steps = len(self._buffer.void)
        lost, blind = self._env.lost - self._lost, self._env.blind - self._blind
        if np.count_nonzero(self._buffer.void) > steps // 2:
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
        actions, thrust = np.array(self._actions), float(np.mean(self._thrusts))
        relative_thrust = thrust / self._env.best_thrust
        frequency = beat_frequency(actions, self._env.link.tick)
        for name, value in (
            ("tank/lost", lost),
            ("tank/blind", blind),
            ("tank/paused", self._paused),
            ("rollout/reward", float(np.mean(self._rewards))),
            ("rollout/thrust", thrust),
            ("rollout/relative_thrust", relative_thrust),
            ("rollout/frequency", frequency),
            ("rollout/fullness", float(np.mean(np.abs(actions)))),
        ):
            self.logger.record(name, value)
        self._lost, self._blind = self._env.lost, self._env.blind
        self._display.explored(thrust, relative_thrust, frequency)

    @property
    def _buffer(self) -> Rollout:
        buffer: Rollout = self.locals["rollout_buffer"]
        return buffer
