"""The link to a simulated fish in this process, with the loop of the robot in virtual time."""

from collections.abc import Callable

from msgspec import Struct
from msgspec.structs import replace

from fishd.camera.simulated import SimulatedCameraSettings, SimulatedSight
from fishd.config import Config, Start, check_tethered
from fishd.controllers.base import Controller
from fishd.core.camera_frames import Stack, StackSettings
from fishd.core.signals import Observation, Truth
from fishd.lab.simulation import VirtualRun
from fishd.learning.links.link import LinkLost, StepResult


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
    """The link to a `VirtualRun` in this process.

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
        self._run: VirtualRun | None = None
        self._sight: SimulatedSight | None = None

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """Start a new fish at rest if requested, drawn or the first; else let it swim on."""
        if self._run is None or new or self._draw:
            self.config = self._draw(self._nominal, seed) if self._draw else self._nominal
            self._run = run = VirtualRun(self.config, None, metered=self._metered)
            controller = FunctionController(self.config, lambda _: self._angle)
            run.loop.set_controller("agent", controller)
            if self._camera:
                self._sight = self._camera.make_sight(self.truth, self.tick)
            self._turn = run.loop.observe(run.next_slot())
        return self.resume()

    def step(self, angle: float) -> StepResult:
        """Apply an angle [rad], and return the result one tick later."""
        run = self._swimming()
        self._angle = angle
        run.loop.act(self._turn)
        self._turn = run.loop.observe(run.next_slot())
        supervisor = run.loop.supervisor
        if supervisor.reason:
            raise LinkLost(f"the loop is in {supervisor.mode}: {supervisor.reason.message}")
        return StepResult(self._turn.observation)

    def look(self) -> Stack | None:
        """Return the frames of the simulated camera; None without a camera."""
        return self._sight.look(self._turn.observation.time) if self._sight else None

    def truth(self) -> Truth:
        """Return the true state of the fish at this tick."""
        truth = self._swimming().loop.robot.truth
        assert truth
        return truth()

    def pause(self, seconds: float) -> None:
        """Do nothing: virtual time stands still while the agent learns."""

    def resume(self) -> Observation:
        """Return the latest observation."""
        return self._turn.observation

    def close(self) -> None:
        """Do nothing: this link holds no resources."""

    def _swimming(self) -> VirtualRun:
        assert self._run
        return self._run
