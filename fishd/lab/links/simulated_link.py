"""The link to a simulated fish in this process, with the loop of the robot in virtual time."""

from collections.abc import Callable

from msgspec import Struct
from msgspec.structs import replace

from fishd.assembly import build_loop, simulated_fish
from fishd.camera.simulated import SimulatedCameraSettings, SimulatedSight
from fishd.config import Config, Start, check_tethered
from fishd.controllers.base import Controller
from fishd.core.camera_frames import Stack, StackSettings
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.core.signals import Observation, Truth
from fishd.lab.links.link import LinkLost, StepResult


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


class _LoopOnFish:
    """The loop of a new simulated fish, which waits between the two halves of a tick."""

    def __init__(
        self,
        config: Config,
        decide: Callable[[Observation], float],
        camera: Camera | None,
        *,
        metered: bool,
    ) -> None:
        """decide: returns the instruction angle for an observation [rad]; called once a tick"""
        clock = VirtualClock()
        fish = simulated_fish(config)
        self.loop = build_loop(config, fish.robot(metered=metered), clock, None)
        self.loop.set_controller("agent", FunctionController(config, decide))
        self.truth = fish.truth
        self.sight = camera.make_sight(fish.truth, config.tick) if camera else None
        self._slots = virtual_slots(clock, config.tick)
        self.turn = self.loop.observe(next(self._slots))

    def tick(self) -> None:
        """Run the second half of this tick and the first half of the next one."""
        self.loop.act(self.turn)
        self.turn = self.loop.observe(next(self._slots))


class SimulatedLink:
    """The link to a `ControlLoop` on a `SimulatedFish` in the same process.

    Each tick of the loop is split: the agent decides between its two halves, while virtual time
    stands still.
    """

    def __init__(
        self,
        config: Config,
        draw: Callable[[Config, int], Config] | None = None,
        camera: Camera | None = None,
        *,
        metered: bool = True,
    ) -> None:
        """
        config: fish, rig, tick and limits; its robot and start are ignored
        draw: returns fish and rig of an episode, by its seed; None where they do not vary
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
        self._draw = draw
        self._camera = camera
        self._metered = metered
        self._angle = 0.0
        self._fish: _LoopOnFish | None = None

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """Start a new fish at rest if requested, drawn or the first; else let it swim on."""
        if self._fish is None or new or self._draw:
            self.config = self._draw(self._nominal, seed) if self._draw else self._nominal
            self._fish = _LoopOnFish(
                self.config, lambda _: self._angle, self._camera, metered=self._metered
            )
        return self.resume()

    def step(self, angle: float) -> StepResult:
        """Apply an angle [rad], and return the result one tick later."""
        fish = self._swimming()
        self._angle = angle
        fish.tick()
        supervisor = fish.loop.supervisor
        if supervisor.reason:
            raise LinkLost(f"the loop is in {supervisor.mode}: {supervisor.reason.message}")
        return StepResult(fish.turn.observation)

    def look(self) -> Stack | None:
        """Return the frames of the simulated camera; None without a camera."""
        fish = self._swimming()
        return fish.sight.look(fish.turn.observation.time) if fish.sight else None

    def truth(self) -> Truth:
        """Return the true state of the fish at this tick."""
        return self._swimming().truth()

    def pause(self, seconds: float) -> None:
        """Do nothing: virtual time stands still while the agent learns."""

    def resume(self) -> Observation:
        """Return the latest observation."""
        return self._swimming().turn.observation

    def close(self) -> None:
        """Do nothing: this link holds no resources."""

    def _swimming(self) -> _LoopOnFish:
        assert self._fish
        return self._fish
