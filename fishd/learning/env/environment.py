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
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from fishd.camera.simulated import SimulatedCameraSettings, TailPainter
from fishd.config import Config, check_tethered
from fishd.controllers.dwell import Dwell
from fishd.controllers.policy.card import READING, Feature, FeatureName, Window
from fishd.core.camera_frames import Stack
from fishd.core.errors import ConfigError
from fishd.core.schema import Reading
from fishd.core.signals import Observation, Truth
from fishd.learning.env.perception import Perception
from fishd.learning.extractors import FeatureExtractor, random_angles
from fishd.learning.links.link import Link, LinkLost
from fishd.learning.settings import EnvironmentSettings
from fishd.virtual.plant.optimum import best_square_wave


def best_thrust(config: Config) -> float:
    """Return the mean thrust of the best square wave of the configured fish [N]."""
    return float(best_square_wave(config.plant, config.amplitude_limit).thrust)


def thrust_scale(config: Config, settings: EnvironmentSettings) -> float:
    """Return the thrust that is rewarded with `reward_scale` [N]."""
    return settings.thrust_scale or best_thrust(config)


def force_scale(config: Config) -> float:
    """Return K λ ω₀² Φ [N], the reaction to a fin released from λΦ (Fu et al., F_y)."""
    plant = config.plant
    return plant.thrust_coefficient * plant.coupling * plant.omega0**2 * config.amplitude_limit


def features(config: Config, settings: EnvironmentSettings) -> tuple[Feature, ...]:
    """Return the features of the observation, each with the value that the network receives as 1.

    The scales come from the physics of the configured fish, not from running averages: they do not
    drift during training, and a policy file contains a few numbers that the user can check.

    Raises `ConfigError` for a fin velocity in a unit that policies do not use.
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
    return (
        *(Feature(name, scales[name]) for name in settings.observation),
        *(_reading_feature(name, config.readings) for name in settings.readings),
    )


def _reading_feature(name: str, readings: Mapping[str, Reading]) -> Feature:
    """Return the input for a reading: −1 to 1 between its limits; without both, its value."""
    if name not in readings:
        raise ConfigError(
            f"environment.readings: the fish has no reading {name}; it has "
            f"{', '.join(readings) or 'none'}"
        )
    low, high = readings[name].low, readings[name].high
    if low is None or high is None or not low < high:
        return Feature(READING + name, 1.0)
    return Feature(READING + name, 0.5 * (high - low), 0.5 * (high + low))


Vector = NDArray[np.float32]

PICTURE = SimulatedCameraSettings(noise=0.0)
"""Settings of a picture without noise."""
PICTURE_SIZE = 256
"""Height and width of a picture [px]."""
_OBSERVATION_BOUND = 1e6
"""Bound of the observation space: finite, as tools expect, and never reached."""
MIN_PAUSE_S, MAX_PAUSE_S = 10.0, 120.0
"""Bounds of the permitted length of a pause whose length is not given; the first pause may take the
longer time [s]."""
FIRST_FRAMES_TIMEOUT_S = 5.0
"""Longest time until a camera shows a whole stack, in real and in virtual time [s]."""
_PAUSE_RATIO = 4.0
"""Ratio of the permitted length of such a pause to the longest pause before it."""


def spaces(features: int) -> tuple[gymnasium.Space[Vector], gymnasium.Space[Vector]]:
    """Return observation and action space; features: number of inputs of the agent."""
    observation: Any = gymnasium.spaces.Box(
        -_OBSERVATION_BOUND, _OBSERVATION_BOUND, (features,), np.float32
    )
    action: Any = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    return observation, action


class SwimEnv(gymnasium.Env[Vector, Vector]):
    """The environment of one fish that swims for thrust.

    `info` of each step contains `thrust` and `lateral_force` (mean F_x and F_y in the tick that
    followed [N]), `lost` (number of ticks with another angle than the action), `blind` (1 if the
    camera did not show that tick) and `paused` (time at neutral since the previous step [s], mostly
    0). A step with `lost` or `blind` truncates its episode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (as Gymnasium's)

    def __init__(
        self,
        link: Link,
        config: Config,
        settings: EnvironmentSettings,
        extractor: FeatureExtractor | None = None,
        truth: Callable[[], Truth] | None = None,
    ) -> None:
        """
        link: link to the fish
        config: configuration that the scales are computed from
        extractor: feature extractor of an agent that sees pictures, fitted before the first step
        truth: returns the true state of a simulated fish, for `render`; None draws no pictures

        Raises `ConfigError` where the fish has another tick or Φ than `config`, or swims freely.
        """
        check_tethered(config.robot, "learning")
        _check_agreement(link, config)
        self.link = link
        self.config = config
        self.features = features(config, settings)
        self.settings = settings
        self.extractor = extractor
        window = Window(settings.history, settings.history * config.tick)
        self.perception = Perception(self.features, extractor, window)
        self.reward_per_newton = settings.reward_scale / thrust_scale(config, settings)
        """Reward per thrust [1/N]."""
        self._price, self._cost = settings.power_price, 0.0  # N/W, N
        shortest = config.limits.dwell if settings.dwell else 0.0
        self._dwell = Dwell(shortest, link.tick, link.amplitude)
        self._dwell_time = 0.0
        """Time of the latest observation after a tick with the shortest dwell [s]."""
        self._held_cost = settings.held_cost * settings.reward_scale
        self.observation_space, self.action_space = spaces(self.perception.inputs)
        self.best_thrust = best_thrust(config)
        """Mean thrust of the best square wave of the configured fish [N]."""
        self.metadata = self.metadata | {"render_fps": round(1.0 / link.tick)}
        self.render_mode = "rgb_array" if truth else None
        self._truth = truth
        self._painter = TailPainter(PICTURE, PICTURE_SIZE) if truth else None
        self._steps = 0
        self._begun = self._closed = False
        self.latest: Observation
        """Latest observation; unset before the first episode."""
        self.stack: Stack | None = None
        """Frames of the latest tick; None where the camera has not shown them."""
        self._shown: Stack | None = None
        """Latest frames of any tick."""
        self.tank_time = 0.0
        """Time that the agent has controlled a fish, pauses included [s]."""
        self.lost = 0
        """Number of ticks with another angle than that of the agent."""
        self.blind = 0
        """Number of ticks that the camera has not shown."""
        self._paused = 0.0
        self._pause_began = 0.0
        self._longest_pause: float | None = None
        """Longest pause until now, in real time [s]; None before the first one."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Vector, dict[str, Any]]:
        """Begin an episode with up to `longest_start` ticks at a random angle.

        With a seed, or with a randomisation, a simulated fish starts again at rest. Any other fish
        swims on from its state; control of it is re-acquired if it was lost. Raises `LinkLost`.
        """
        self._check_open()
        super().reset(seed=seed)
        draw = self.np_random
        self.latest = self.link.reset(int(draw.integers(2**31)), new=seed is not None)
        self.perception.forget()
        if self.settings.own_fish and self.link.config:
            self._adapt_to(self.link.config)
        self._begun = True
        self._steps = 0
        self._await_frames()
        angle = self.link.amplitude * float(draw.uniform(-1.0, 1.0))
        lost = sum(
            self.advance(angle) for _ in range(int(draw.integers(self.settings.longest_start + 1)))
        )
        self._dwell.activate(self.latest.instruction_angle)
        return self._agent_inputs(), self._info(lost)

    def _adapt_to(self, fish: Config) -> None:
        """Use the scale of the thrust, and the shortest dwell, of the fish that swims now."""
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
        lost = self.swim(_read_action(action) * self.link.amplitude)
        self._steps += 1
        reward = self.reward_per_newton * (self.latest.fx - self._cost)
        reward -= self._held_cost * self._dwell.held
        info = self._info(lost)
        truncated = self._steps >= self.settings.episode or lost + info["blind"] > 0
        self._paused = 0.0
        return self._agent_inputs(), reward, False, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the fish from above, its head to the left: height, width and 3 colours.

        None without a `render_mode`; raises `ResetNeeded` before the first episode.
        """
        if not (self._painter and self._truth):
            return None
        if not self._begun:
            raise ResetNeeded("no episode has begun: call reset before render")
        grey = self._painter.paint(self._truth().alpha, 0.0, 0.0)
        return np.repeat(grey[:, :, np.newaxis], 3, axis=2)

    def swim(self, angle: float) -> int:
        """Swim one tick at an angle [rad], or at the previous one if it would reverse too soon.

        Returns the number of ticks lost. Raises `LinkLost`.
        """
        lost = self.advance(self._dwell.apply(angle, self.link.tick))
        self._dwell_time = self.latest.time
        return lost

    def advance(self, angle: float) -> int:
        """Swim one tick at an angle [rad], outside of any episode; return the number of ticks lost.

        Raises `LinkLost`, and `ConfigError` where power has a price, but is not known.
        """
        before = self.latest.time
        self.latest, lost = self.link.step(angle)
        if self._price:
            power = self.latest.readings.get("power")
            if power is None:
                raise ConfigError(
                    "environment.power_price: this fish has no reading power: learn in "
                    "simulation, add a power meter to its sensors, or set it to 0"
                )
            self._cost = self._price * power
        self.perception.note(self.latest)
        if self.extractor and not self._look():
            self.blind += 1
        self.tank_time += self.latest.time - before
        self.lost += lost
        return lost

    def excite_randomly(
        self, seed: int, ticks: int, stop: Callable[[], bool] = lambda: False
    ) -> bool:
        """Move at random, outside of any episode, and fit the extractor to the pictures of that.

        ticks: length of the motion
        stop: called before each tick; True ends the motion

        Returns False where it was stopped; else the fish is in a pause afterwards. Raises
        `LinkLost`, and `NoMotion` where the tail is not visible.
        """
        assert self.extractor
        assert self._shown
        frames, angles = [], []
        for angle in random_angles(seed, ticks, self.link.amplitude).tolist():
            if stop():
                return False
            self.advance(angle)
            frames.append(self._shown[0])
            angles.append(
                self.latest.instruction_angle
            )  # in a lost tick, not that of the random excitation
        self.pause()  # the fit takes longer than fishd waits
        self.extractor.fit(np.stack(frames), np.array(angles))
        return True

    def pause(self, seconds: float | None = None) -> None:
        """Hold the fish at neutral while the agent learns.

        seconds: longest time [s]; None: a multiple of the longest pause until now
        """
        if seconds is None:
            seconds = MAX_PAUSE_S
            if self._longest_pause is not None:
                seconds = min(seconds, max(MIN_PAUSE_S, _PAUSE_RATIO * self._longest_pause))
        self._pause_began = time.monotonic()
        self.link.pause(seconds)

    def resume(self) -> Vector:
        """End the pause; return the observation that the next action answers.

        The observation before the pause must not be answered, since the fish is at rest now.
        """
        before = self.latest.time
        took = time.monotonic() - self._pause_began
        self._longest_pause = max(took, self._longest_pause or 0.0)
        self.latest = self.link.resume()
        self._await_frames()
        if self.latest.time > self._dwell_time:
            self._dwell.activate(self.latest.instruction_angle)
        waited = self.latest.time - before
        self._paused += waited
        self.tank_time += waited
        return self._agent_inputs()

    def close(self) -> None:
        """Leave the fish at neutral."""
        self._closed = True
        self.link.close()

    def _look(self) -> bool:
        """Store the stack of this tick; return False if the camera has not shown it."""
        self.stack = self.link.look()
        self._shown = self.stack or self._shown
        return self.stack is not None

    def _await_frames(self) -> None:
        """Stay at neutral until the camera shows a whole stack; raises `LinkLost`."""
        if self.extractor is None or self._look():
            return
        virtual_start, real_start = self.latest.time, time.monotonic()
        while (
            min(self.latest.time - virtual_start, time.monotonic() - real_start)
            < FIRST_FRAMES_TIMEOUT_S
        ):
            self.latest = self.link.step(0.0).observation
            if self._look():
                return
        raise LinkLost(
            f"the camera has shown no whole stack of frames for {FIRST_FRAMES_TIMEOUT_S:g} s: they "
            "come too seldom or too late for camera.stack; give that a larger delay or oldest, or "
            "the camera a higher rate"
        )

    def _agent_inputs(self) -> Vector:
        return self.perception.vector(self.latest, self._shown)

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("this environment is closed; make another one")

    def _info(self, lost: int) -> dict[str, Any]:
        blind = int(self.extractor is not None and self.stack is None)
        return {
            "thrust": self.latest.fx,
            "lateral_force": self.latest.fy,
            "lost": lost,
            "blind": blind,
            "paused": self._paused,
        }


def _check_agreement(link: Link, config: Config) -> None:
    """Raise `ConfigError` where the fish has another tick or Φ than the configuration."""
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


def _read_action(action: Vector) -> float:
    """Return the number of an action, clipped to [-1, 1]; raises ValueError."""
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (1,):
        raise ValueError(f"an action of shape {values.shape} is not valid: (1,) is needed, φ_c/Φ")
    share = float(values[0])
    if not math.isfinite(share):
        raise ValueError(f"an action of {share} is not valid: a number in [-1, 1] is needed, φ_c/Φ")
    return max(-1.0, min(1.0, share))
