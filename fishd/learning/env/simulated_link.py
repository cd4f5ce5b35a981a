"""A simulated fish in this process, on the virtual clock: the robot's own loop, far faster."""

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

_VARIED = ("omega0", "xi", "servo_speed", "coupling")
_VARIED_TOO = ("servo_lag", "thrust_coefficient", "lateral_drag")
"""Parameters of the plant that a randomisation has a share for."""
_ADDED = ("servo_delay", "servo_dead_zone", "backlash")
"""Those that become larger by up to the randomisation."""


def drawn(config: Config, spread: Randomisation, seed: int) -> Config:
    """A fish and a rig from anywhere in the range, to train on for a fish that is not known."""
    draw = np.random.default_rng(seed)
    if spread.fish:
        config = replace(config, plant=spread.fish[int(draw.integers(len(spread.fish)))])
    return _varied(config, spread, lambda: draw.uniform(-1.0, 1.0), int(draw.integers(2**31)))


def at_edge(config: Config, spread: Randomisation, seed: int) -> Config:
    """A fish and a rig with every varied parameter at one end of its range, to evaluate on.

    Of a list of fish it is the one of this number, from the beginning again after the last.
    """
    draw = np.random.default_rng(seed)
    if spread.fish:
        config = replace(config, plant=spread.fish[seed % len(spread.fish)])
    return _varied(config, spread, lambda: float(draw.choice((-1.0, 1.0))), config.simulation.seed)


def _varied(
    config: Config, spread: Randomisation, place: Callable[[], float], noise_seed: int
) -> Config:
    """place: draws for one parameter its place in the range, from -1 to 1"""

    def varied(value: float, share: float) -> float:
        return value * math.exp(place() * math.log1p(share))

    plant, rig = config.plant, config.simulation
    changed = {name: varied(getattr(plant, name), getattr(spread, name)) for name in _VARIED}
    noise = varied(rig.noise, spread.noise)
    offset_y = rig.offset_y + spread.offset * place()
    changed |= {name: varied(getattr(plant, name), getattr(spread, name)) for name in _VARIED_TOO}
    for name in _ADDED:
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
    """Any function as a controller."""

    Parameters = _NoParameters

    def __init__(self, config: Config, decide: Callable[[Observation], float]) -> None:
        """decide: observation in, instruction angle out [rad]; called once a tick"""
        super().__init__(_NoParameters(), config.limits)
        self._decide = decide

    def update(self, observation: Observation) -> float:
        """What the function returns [rad]."""
        return self._decide(observation)


class Camera(Struct, frozen=True):
    """A simulated camera, and which of its frames an agent is shown."""

    settings: SimulatedCameraSettings
    stack: StackSettings

    def on(self, truth: Callable[[], Truth], tick: float) -> SimulatedSight:
        """Look at a fish that is at rest; tick: period of the loop [s]"""
        return SimulatedSight(self.settings, self.stack, tick, truth)


class SimulatedLink:
    """The link to a `ControlLoop` on a `SimulatedFish` in the same process.

    Each turn of the loop is split: the agent decides between its two halves, while virtual time
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
        randomisation: how much the fish and rig of each episode vary; by default not at all
        camera: what looks at the fish, if anything does
        metered: False where the power of the servo has no reader, which is quicker

        Raises `ConfigError` for a fish that swims freely.
        """
        check_tethered(config.robot, "learning")
        self.tick = config.tick
        self.amplitude = config.amplitude_limit
        self.config = replace(config, robot="simulated", start=Start())
        """The fish that swims now, as drawn."""
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
        """A fish at rest where it is to be new, is randomised or is the first; else it swims on."""
        if self._turn is None or new or self._varies:
            config = self._nominal
            self.config = drawn(config, self._randomisation, seed) if self._varies else config
            self._begin()
        return self.resume()

    def step(self, angle: float) -> StepResult:
        """Act, and observe what comes of it one tick later."""
        assert self._turn
        self._angle = angle
        self._loop.act(self._turn)
        self._turn = self._loop.observe(next(self._slots))
        reason = self._loop.supervisor.reason
        if reason:
            raise LinkLost(f"the loop is in {self._loop.supervisor.mode}: {reason.message}")
        return StepResult(self._turn.observation, power=self._turn.power)

    def look(self) -> Stack | None:
        """What the simulated camera shows."""
        return self._sight.look(self.resume().time) if self._sight else None

    def pause(self, seconds: float) -> None:
        """Nothing: virtual time stands still while the agent learns."""

    def resume(self) -> Observation:
        """The latest observation."""
        assert self._turn
        return self._turn.observation

    def close(self) -> None:
        """Nothing is held."""

    def _begin(self) -> None:
        config, clock = self.config, VirtualClock()
        fish = simulated_fish(config)
        robot = fish.robot(metered=self._metered)
        self._loop = build_loop(config, robot, clock, None)
        self._loop.set_controller("agent", FunctionController(config, lambda _: self._angle))
        self._slots = virtual_slots(clock, config.tick)
        if self._camera:
            self._sight = self._camera.on(fish.truth, config.tick)
        self._turn = self._loop.observe(next(self._slots))
