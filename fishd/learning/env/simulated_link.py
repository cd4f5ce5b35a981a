"""The link to a simulated fish in this process, with the loop of the robot in virtual time."""

import math
from collections.abc import Callable, Iterator

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from fishd.assembly import build_loop, simulated_fish
from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.camera.simulated.sight import SimulatedSight
from fishd.config import Config, Start, check_tethered
from fishd.control.loop import ControlLoop, Turn
from fishd.controllers.base import Controller
from fishd.core.camera_frames import Stack, StackSettings
from fishd.core.clock import Slot, VirtualClock, virtual_slots
from fishd.core.signals import Observation, Truth
from fishd.learning.env.link import LinkLost, StepResult
from fishd.learning.settings import Randomisation

_FIRST_VARIED = ("omega0", "xi", "servo_speed", "coupling")
_LATER_VARIED = ("servo_lag", "thrust_coefficient", "lateral_drag")
"""Parameters of the plant that a randomisation has a share for, in the order of the draws: the
later ones are drawn after the noise and the offset."""
_INCREASED = ("servo_delay", "servo_dead_zone", "backlash")
"""Parameters of the plant that a randomisation increases by up to its value."""


def draw_fish(config: Config, spread: Randomisation, seed: int) -> Config:
    """Return a random fish and rig of the range, to train on for a fish that is not known."""
    random = np.random.default_rng(seed)
    if spread.fish:
        config = replace(config, plant=spread.fish[int(random.integers(len(spread.fish)))])
    return _vary(config, spread, lambda: random.uniform(-1.0, 1.0), int(random.integers(2**31)))


def draw_edge_fish(config: Config, spread: Randomisation, seed: int) -> Config:
    """Return a fish and rig with every varied parameter at one end of its range, to evaluate on.

    A list of fish is indexed by the seed, modulo its length.
    """
    random = np.random.default_rng(seed)
    if spread.fish:
        config = replace(config, plant=spread.fish[seed % len(spread.fish)])
    return _vary(config, spread, lambda: float(random.choice((-1.0, 1.0))), config.simulation.seed)


def _vary(
    config: Config, spread: Randomisation, place: Callable[[], float], noise_seed: int
) -> Config:
    """Return a varied configuration.

    place: draws the place of a parameter in its range, from -1 to 1
    """

    def vary(value: float, share: float) -> float:
        return value * math.exp(place() * math.log1p(share))

    plant, rig = config.plant, config.simulation
    changed = {name: vary(getattr(plant, name), getattr(spread, name)) for name in _FIRST_VARIED}
    noise = vary(rig.noise, spread.noise)
    offset_y = rig.offset_y + spread.offset * place()
    changed |= {name: vary(getattr(plant, name), getattr(spread, name)) for name in _LATER_VARIED}
    for name in _INCREASED:
        changed[name] = getattr(plant, name) + 0.5 * (1.0 + place()) * getattr(spread, name)
    changed["servo_reaction"] = plant.servo_reaction + spread.servo_reaction * place()
    rotation = rig.rotation + spread.rotation * place()
    return replace(
        config,
        plant=replace(plant, **changed),
        simulation=replace(rig, noise=noise, offset_y=offset_y, rotation=rotation, seed=noise_seed),
    )


class _NoParameters(Struct, frozen=True, forbid_unknown_fields=True):
    pass


class FunctionController(Controller[_NoParameters]):
    """A controller that calls a function."""

    Parameters = _NoParameters

    def __init__(self, config: Config, decide: Callable[[Observation], float]) -> None:
        """decide: returns the instruction angle for an observation [rad]; called once a tick"""
        super().__init__(_NoParameters(), config.limits)
        self._decide = decide

    def update(self, observation: Observation) -> float:
        """Return the angle that the function returns [rad]."""
        return self._decide(observation)


class Camera(Struct, frozen=True):
    """A simulated camera, and the stack of its frames that an agent receives."""

    settings: SimulatedCameraSettings
    stack: StackSettings

    def make_sight(self, truth: Callable[[], Truth], tick: float) -> SimulatedSight:
        """Return the sight of a fish that is at rest; tick: period of the loop [s]."""
        return SimulatedSight(self.settings, self.stack, tick, truth)


class SimulatedLink:
    """The link to a `ControlLoop` on a `SimulatedFish` in the same process.

    Each tick of the loop is split: the agent decides between its two halves, while virtual time
    stands still.
    """

    def __init__(
        self,
        config: Config,
        randomisation: Randomisation | None = None,
        camera: Camera | None = None,
        *,
        metered: bool = True,
    ) -> None:
        """
        config: fish, rig, tick and limits; its robot and start are ignored
        randomisation: ranges of the fish and rig of each episode; by default they do not vary
        camera: camera that sees the fish; None: it is not seen
        metered: whether to compute the power of the servo; False is faster

        Raises `ConfigError` for a fish that swims freely.
        """
        check_tethered(config.robot, "learning")
        self.tick = config.tick
        self.amplitude = config.amplitude_limit
        self.config = replace(config, robot="simulated", start=Start())
        """Configuration of the fish that swims now, as drawn."""
        self._nominal = self.config
        self._randomisation = randomisation or Randomisation()
        self._varies = self._randomisation != Randomisation()
        self._camera = camera
        self._metered = metered
        self._sight: SimulatedSight | None = None
        self._angle = 0.0
        self._loop: ControlLoop
        self._slots: Iterator[Slot]
        self._turn: Turn | None = None

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """Start a new fish at rest if requested, randomised or the first; else let it swim on."""
        if self._turn is None or new or self._varies:
            config = self._nominal
            self.config = draw_fish(config, self._randomisation, seed) if self._varies else config
            self._begin()
        return self.resume()

    def step(self, angle: float) -> StepResult:
        """Apply an angle [rad], and return the result one tick later."""
        assert self._turn
        self._angle = angle
        self._loop.act(self._turn)
        self._turn = self._loop.observe(next(self._slots))
        reason = self._loop.supervisor.reason
        if reason:
            raise LinkLost(f"the loop is in {self._loop.supervisor.mode}: {reason.message}")
        return StepResult(self._turn.observation, power=self._turn.power)

    def look(self) -> Stack | None:
        """Return the frames of the simulated camera; None without a camera."""
        return self._sight.look(self.resume().time) if self._sight else None

    def pause(self, seconds: float) -> None:
        """Do nothing: virtual time stands still while the agent learns."""

    def resume(self) -> Observation:
        """Return the latest observation."""
        assert self._turn
        return self._turn.observation

    def close(self) -> None:
        """Do nothing: this link holds no resources."""

    def _begin(self) -> None:
        config, clock = self.config, VirtualClock()
        fish = simulated_fish(config)
        robot = fish.robot(metered=self._metered)
        self._loop = build_loop(config, robot, clock, None)
        self._loop.set_controller("agent", FunctionController(config, lambda _: self._angle))
        self._slots = virtual_slots(clock, config.tick)
        if self._camera:
            self._sight = self._camera.make_sight(fish.truth, config.tick)
        self._turn = self._loop.observe(next(self._slots))
