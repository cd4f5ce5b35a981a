"""The Gymnasium environment: swim for thrust, one step a tick.

| | | |
|---|---|---|
| observation | F_y, Ḟ_y, φ_c, its predecessor, fin velocity | each over its scale (`features`) |
| | of the latest `history` ticks | newest first |
| action | φ_c/Φ in [-1, 1] | applied from the tick that it answers until the next |
| reward | `reward_scale` · (F_x − `power_price` · P) / `thrust_scale` | of the tick that followed |
| | −`reward_scale` · `held_cost` | in a tick in which the shortest dwell held a reversal back |

An episode is truncated after `episode` steps, and never terminates: a fish has no goal to reach.
"""

import math
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from fishd.config import Config, check_tethered
from fishd.controllers.dwell import Dwell
from fishd.controllers.policy.card import Feature, FeatureName, Window
from fishd.core.camera_frames import Stack
from fishd.core.errors import ConfigError
from fishd.core.signals import Observation
from fishd.learning.env.link import Link, LinkLost
from fishd.learning.env.perception import Perception
from fishd.learning.eyes.base import Eye
from fishd.learning.eyes.making import babble
from fishd.learning.settings import EnvironmentSettings
from fishd.virtual.plant.optimum import best_square_wave


def best_thrust(config: Config) -> float:
    """Mean thrust of the best square wave of the configured fish [N]."""
    return float(best_square_wave(config.plant, config.amplitude_limit).thrust)


def thrust_scale(config: Config, settings: EnvironmentSettings) -> float:
    """The thrust that is rewarded with `reward_scale` [N]."""
    return settings.thrust_scale or best_thrust(config)


def force_scale(config: Config) -> float:
    """K λ ω₀² Φ [N]: the reaction to a fin that is held at λΦ and let go (Fu et al., F_y)."""
    plant = config.plant
    return plant.thrust_coefficient * plant.coupling * plant.omega0**2 * config.amplitude_limit


def features(config: Config, settings: EnvironmentSettings) -> tuple[Feature, ...]:
    """The inputs of the network, each with the value that it sees as 1 for the configured fish.

    The scales come from the physics, not from running averages: nothing drifts during training, and
    a policy file carries a few numbers that a person can check.

    Raises `ConfigError` for a fin velocity that no policy would know.
    """
    if config.estimator.kind != "lateral_force" and "fin_velocity" in settings.observation:
        raise ConfigError(
            "estimator.kind: observer is not possible with fin_velocity in "
            "environment.observation: policies see it as lateral_force gives it; use that, or "
            "leave fin_velocity out"
        )
    force = settings.force_scale or force_scale(config)
    omega0 = config.plant.omega0
    scales: dict[FeatureName, float] = {
        "fx": thrust_scale(config, settings),
        "fy": force,
        "fy_rate": force * omega0,
        "fin_velocity": force / omega0,  # the estimate is an integral of F_y
        "instruction_angle": config.amplitude_limit,
        "previous_angle": config.amplitude_limit,
        "side_time": math.pi / omega0,
    }
    return tuple(Feature(name, scales[name]) for name in settings.observation)


Vector = NDArray[np.float32]

_FARTHEST = 1e6
"""Bound of the observation space: finite, as tools expect, and never reached."""
SHORTEST_PAUSE, LONGEST_PAUSE = 10.0, 120.0
"""Bounds of a pause whose length is not given; the first one is the longest [s]."""
FIRST_FRAMES = 5.0
"""How long a camera may take to show a whole stack, in real and in virtual time [s]."""
_ALLOWANCE = 4.0
"""Such a pause may last so many times the longest one so far."""


def spaces(features: int) -> tuple[gymnasium.Space[Vector], gymnasium.Space[Vector]]:
    """Observation and action space of an agent that sees so many features."""
    seen: Any = gymnasium.spaces.Box(-_FARTHEST, _FARTHEST, (features,), np.float32)
    done: Any = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    return seen, done


class SwimEnv(gymnasium.Env[Vector, Vector]):
    """One fish that swims for thrust.

    `info` of each step holds `thrust` and `lateral_force` (mean F_x and F_y in the tick that
    followed [N]), `lost` (ticks in which another angle than the action was applied), `blind` (1
    where the camera did not show that tick) and `paused` (how long the fish has waited at neutral
    since the previous step [s], mostly 0). A step with `lost` or `blind` ends its episode: it is
    truncated.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own way)

    def __init__(
        self, link: Link, config: Config, settings: EnvironmentSettings, eye: Eye | None = None
    ) -> None:
        """
        link: to the fish
        config: the fish that the scales are made for
        eye: what makes numbers of pictures, where the agent sees any; fit it before the first step

        Raises `ConfigError` where the fish has another tick or Φ than `config`, or swims freely.
        """
        check_tethered(config.robot, "learning")
        _check_agreement(link, config)
        self.link = link
        self.config = config
        self.features = features(config, settings)
        self.settings = settings
        self.eye = eye
        window = Window(settings.history, settings.history * config.tick)
        self.perception = Perception(self.features, eye, window)
        self.reward_per_newton = settings.reward_scale / thrust_scale(config, settings)
        """By which F_x is rewarded [1/N]."""
        self._price, self._cost = settings.power_price, 0.0  # N/W, N
        shortest = config.limits.dwell if settings.dwell else 0.0
        self._dwell = Dwell(shortest, link.tick, link.amplitude)
        self._limited = 0.0
        """The time of the latest observation after a tick with the shortest dwell [s]."""
        self._held_cost = settings.held_cost * settings.reward_scale
        self.observation_space, self.action_space = spaces(self.perception.inputs)
        self.best_thrust = best_thrust(config)
        """Mean thrust of the best square wave of the configured fish [N]."""
        self._steps = 0
        self._begun = self._closed = False
        self.latest: Observation
        """The latest observation, once an episode has begun."""
        self.stack: Stack | None = None
        """The frames of this tick; None where the camera has not shown them."""
        self._shown: Stack | None = None
        """The latest frames, of whichever tick."""
        self.tank_time = 0.0
        """How long the agent has controlled a fish, pauses included [s]."""
        self.lost = 0
        """Ticks in which another angle than the agent's was applied."""
        self.blind = 0
        """Ticks that the camera has not shown."""
        self._paused = 0.0
        self._pause_began = 0.0
        self._longest_pause: float | None = None
        """In real time [s]."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Begin an episode: up to `longest_start` ticks at a random angle come first.

        With a seed, or with a randomisation, a simulated fish begins anew, at rest. Any other one
        swims on from where it is; control of it is re-acquired where it was lost. Raises
        `LinkLost`.
        """
        self._check_open()
        super().reset(seed=seed)
        draw = self.np_random
        self.latest = self.link.reset(int(draw.integers(2**31)), new=seed is not None)
        self.perception.forget()
        if self.settings.own_fish and self.link.config:
            self._suit(self.link.config)
        self._begun = True
        self._steps = 0
        self._await_frames()
        angle = self.link.amplitude * float(draw.uniform(-1.0, 1.0))
        lost = sum(
            self.advance(angle) for _ in range(int(draw.integers(self.settings.longest_start + 1)))
        )
        self._dwell.activate(self.latest.instruction_angle)
        return self._seen(), self._info(lost)

    def _suit(self, fish: Config) -> None:
        """Reward the thrust of this fish by its own best, and hold reversals back as it needs."""
        self.reward_per_newton = self.settings.reward_scale / thrust_scale(fish, self.settings)
        shortest = fish.limits.dwell if self.settings.dwell else 0.0
        self._dwell = Dwell(shortest, self.link.tick, self.link.amplitude)

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, Any]]:
        """Apply an instruction angle for one tick.

        Raises `LinkLost`, ValueError for an invalid action, `ResetNeeded` before the first episode
        and RuntimeError after `close`.
        """
        self._check_open()
        if not self._begun:
            raise ResetNeeded("no episode has begun: call reset before step")
        lost = self.swim(_share(action) * self.link.amplitude)
        self._steps += 1
        reward = self.reward_per_newton * (self.latest.fx - self._cost)
        reward -= self._held_cost * self._dwell.held
        info = self._info(lost)
        truncated = self._steps >= self.settings.episode or lost + info["blind"] > 0
        self._paused = 0.0
        return self._seen(), reward, False, truncated, info

    def swim(self, angle: float) -> int:
        """Swim one tick at an angle [rad], or at that of before where it would reverse too soon.

        Gives the number of ticks lost. Raises `LinkLost`.
        """
        lost = self.advance(self._dwell.apply(angle, self.link.tick))
        self._limited = self.latest.time
        return lost

    def advance(self, angle: float) -> int:
        """Swim one tick at an angle [rad], outside of any episode; the number of ticks lost.

        Raises `LinkLost`, and `ConfigError` where power has a price, but is not known.
        """
        before = self.latest.time
        self.latest, lost, power = self.link.step(angle)
        if self._price:
            if power is None:
                raise ConfigError(
                    "environment.power_price: the power of the servo is not known here: learn in "
                    "simulation, or set it to 0"
                )
            self._cost = self._price * power
        self.perception.note(self.latest)
        if self.eye and not self._look():
            self.blind += 1
        self.tank_time += self.latest.time - before
        self.lost += lost
        return lost

    def babble(self, seed: int, ticks: int, stop: Callable[[], bool] = lambda: False) -> bool:
        """Move at random, outside of any episode, and let the eye find out what it sees of that.

        ticks: for how long
        stop: called after each of them; True ends it

        False where it was stopped; else the fish is in a pause afterwards. Raises `LinkLost`, and
        `NoMotion` where the tail is not to be seen.
        """
        assert self.eye
        assert self._shown
        frames, angles = [], []
        for angle in babble(seed, ticks, self.link.amplitude).tolist():
            if stop():
                return False
            self.advance(angle)
            frames.append(self._shown[0])
            angles.append(self.latest.instruction_angle)  # of a lost tick, another one
        self.pause()  # to find it out takes longer than fishd waits
        self.eye.fit(np.stack(frames), np.array(angles))
        return True

    def pause(self, seconds: float | None = None) -> None:
        """Let the fish wait at neutral while the agent learns.

        seconds: at most; None: a multiple of the longest pause so far
        """
        if seconds is None:
            seconds = LONGEST_PAUSE
            if self._longest_pause is not None:
                seconds = min(seconds, max(SHORTEST_PAUSE, _ALLOWANCE * self._longest_pause))
        self._pause_began = time.monotonic()
        self.link.pause(seconds)

    def resume(self) -> Vector:
        """End the pause; the observation that the next action answers.

        The one before the pause must not be answered: the fish has come to rest meanwhile.
        """
        before = self.latest.time
        took = time.monotonic() - self._pause_began
        self._longest_pause = max(took, self._longest_pause or 0.0)
        self.latest = self.link.resume()
        self._await_frames()
        if self.latest.time > self._limited:
            self._dwell.activate(self.latest.instruction_angle)
        waited = self.latest.time - before
        self._paused += waited
        self.tank_time += waited
        return self._seen()

    def close(self) -> None:
        """Leave the fish at neutral."""
        self._closed = True
        self.link.close()

    def _look(self) -> bool:
        """Take the stack of this tick; False if the camera has not shown it."""
        self.stack = self.link.look()
        self._shown = self.stack or self._shown
        return self.stack is not None

    def _await_frames(self) -> None:
        """Stay at neutral until the camera shows a whole stack; raises `LinkLost`."""
        if self.eye is None or self._look():
            return
        begun, began = self.latest.time, time.monotonic()
        while min(self.latest.time - begun, time.monotonic() - began) < FIRST_FRAMES:
            self.latest = self.link.step(0.0).observation
            if self._look():
                return
        raise LinkLost(
            f"the camera has shown no whole stack of frames for {FIRST_FRAMES:g} s: they come too "
            "seldom or too late for camera.stack; give that a larger delay or oldest, or the "
            "camera a higher rate"
        )

    def _seen(self) -> Vector:
        return self.perception.vector(self.latest, self._shown)

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("this environment is closed; make another one")

    def _info(self, lost: int) -> dict[str, Any]:
        blind = int(self.eye is not None and self.stack is None)
        return {
            "thrust": self.latest.fx,
            "lateral_force": self.latest.fy,
            "lost": lost,
            "blind": blind,
            "paused": self._paused,
        }


def _check_agreement(link: Link, config: Config) -> None:
    """Raise `ConfigError` where the fish has another tick or Φ than the scales are made for."""
    for key, here, there, unit in (
        ("tick", config.tick, link.tick, "s"),
        ("amplitude_limit", config.amplitude_limit, link.amplitude, "rad"),
    ):
        if not math.isclose(here, there, rel_tol=1e-9):
            raise ConfigError(
                f"{key}: {here:g} {unit} in this configuration, {there:g} {unit} in the fishd that "
                "runs; what the network sees is scaled by it, so give the file that fishd was "
                "started with, or none"
            )


def _share(action: Vector) -> float:
    """The one number of an action, clipped to [-1, 1]; raises ValueError."""
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (1,):
        raise ValueError(f"an action of shape {values.shape} is not valid: (1,) is needed, φ_c/Φ")
    share = float(values[0])
    if not math.isfinite(share):
        raise ValueError(f"an action of {share} is not valid: a number in [-1, 1] is needed, φ_c/Φ")
    return max(-1.0, min(1.0, share))
