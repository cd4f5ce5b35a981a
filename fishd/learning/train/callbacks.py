"""What happens during a rollout, besides PPO's own business: figures, void steps, pause, stop."""

from collections.abc import Callable

import numpy as np
from msgspec import Struct
from stable_baselines3.common.callbacks import BaseCallback

from fishd.learning.environment import SwimEnv
from fishd.learning.link import LinkLost
from fishd.learning.ppo import Rollout
from fishd.learning.trials import beat_frequency


class Figures(Struct, frozen=True):
    """How the fish swam in a rollout, exploration included; means over its steps."""

    reward: float
    thrust: float
    """[N]"""
    frequency: float
    """Tail beats per second, from the actions' changes of side [Hz]."""
    fullness: float
    """|φ_c|/Φ"""
    lost: int
    """Ticks since the rollout before in which another angle than the agent's was in force."""
    paused: float
    """How long the fish waited at neutral before it [s]."""


class Watch(BaseCallback):
    """Follows each rollout, step by step, and pauses the fish at its end."""

    def __init__(self, env: SwimEnv, stop: Callable[[], bool], moved: Callable[[], None]) -> None:
        """
        stop: asked after each step whether to stop there
        moved: called after each step
        """
        super().__init__()
        self._env = env
        self._stop = stop
        self._moved = moved
        self.stopped = False
        """Was the latest rollout ended early? Nothing was learned from it then."""
        self._lost = self._counted = 0
        self._forget()

    @property
    def moves(self) -> int:
        """Steps of the latest rollout so far."""
        return len(self._actions)

    def figures(self) -> Figures:
        """Those of the rollout that has just ended."""
        actions = np.array(self._actions)
        return Figures(
            reward=float(np.mean(self._rewards)),
            thrust=float(np.mean(self._thrusts)),
            frequency=beat_frequency(actions, self._env.link.tick),
            fullness=float(np.mean(np.abs(actions))),
            lost=self._lost,
            paused=self._paused,
        )

    def _forget(self) -> None:
        self._rewards: list[float] = []
        self._thrusts: list[float] = []
        self._actions: list[float] = []
        self._paused = 0.0

    def _on_rollout_start(self) -> None:
        self._forget()

    def _on_step(self) -> bool:
        buffer, info = self._buffer, self.locals["infos"][0]
        self._rewards.append(float(self.locals["rewards"][0]))
        self._thrusts.append(info["thrust"])
        self._actions.append(float(self.locals["clipped_actions"][0, 0]))
        self._paused += info["paused"]
        buffer.void[buffer.pos] = info["lost"] > 0  # where this step is going to be kept
        self._moved()
        self.stopped = self._stop()
        return not self.stopped

    def _on_rollout_end(self) -> None:
        self._env.pause()
        self._lost, self._counted = self._env.lost - self._counted, self._env.lost
        steps = len(self._buffer.void)
        if np.count_nonzero(self._buffer.void) > steps // 2:
            raise LinkLost(
                f"in most of the last {steps} steps the agent's action came too late for its tick; "
                "run it on a faster or less busy machine, nearer to fishd"
            )

    @property
    def _buffer(self) -> Rollout:
        buffer: Rollout = self.locals["rollout_buffer"]
        return buffer
