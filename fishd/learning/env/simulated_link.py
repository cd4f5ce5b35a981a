"""A simulated fish in this process, on the virtual clock: the robot's own loop, far faster."""

from collections.abc import Iterator

from msgspec import Struct
from msgspec.structs import replace

from fishd.build import build_loop
from fishd.clock import Slot, VirtualClock, VirtualTicker
from fishd.config import Config, Start
from fishd.controllers.base import Controller
from fishd.hardware.simulated import SimulatedFish
from fishd.learning.link import LinkLost, Sensed
from fishd.learning.settings import Randomisation
from fishd.learning.variation import drawn
from fishd.loop import ControlLoop, Turn
from fishd.plant.tethered import TrueWindow
from fishd.signals import Event, Observation, Tick


class _NoParameters(Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Puppet(Controller[_NoParameters]):
    """Commands what it was told last."""

    Parameters = _NoParameters
    command = 0.0
    """[rad]"""

    def update(self, observation: Observation) -> float:
        """The command."""
        return self.command


class Silence:
    """A publisher that nobody listens to."""

    def tick(self, tick: Tick) -> None:
        """Drop."""

    def event(self, event: Event) -> None:
        """Drop."""


class InProcess:
    """The link to a `ControlLoop` on a `SimulatedFish`, in the same process.

    A turn of the loop is halved: the agent decides between its observation and its action, while
    virtual time stands still.
    """

    restartable = True

    def __init__(self, config: Config, randomisation: Randomisation | None = None) -> None:
        """
        config: fish, rig, tick and limits; its robot and start are ignored
        randomisation: how much `restart` varies fish and rig; None leaves them as configured
        """
        self.tick = config.tick
        self.amplitude = config.amplitude_limit
        self.config = replace(config, robot="simulated", start=Start())
        """The fish that swims now, as drawn."""
        self._nominal = self.config
        self._randomisation = randomisation
        self.varies = randomisation is not None
        self._fish: SimulatedFish
        self._loop: ControlLoop
        self._slots: Iterator[Slot]
        self._puppet: Puppet
        self._turn: Turn | None = None

    def start(self) -> Observation:
        """The fish of the configuration, at rest; where one swims already, where it is now."""
        if self._turn is None:
            self._begin(self._nominal)
        assert self._turn
        return self._turn.observation

    def restart(self, seed: int) -> Observation:
        """A new fish at rest; without a randomisation always the same."""
        spread = self._randomisation
        self._begin(drawn(self._nominal, spread, seed) if spread else self._nominal)
        return self.start()

    def step(self, angle: float) -> Sensed:
        """Act, and observe what comes of it one tick later."""
        assert self._turn
        self._puppet.command = angle
        self._loop.act(self._turn)
        self._turn = self._loop.observe(next(self._slots))
        reason = self._loop.supervisor.reason
        if reason:
            raise LinkLost(f"the loop is in {self._loop.supervisor.mode}: {reason.message}")
        return Sensed(self._turn.observation)

    def pause(self, seconds: float) -> None:
        """Nothing: virtual time stands still while the agent thinks."""

    def resume(self) -> Observation:
        """Where the fish was."""
        return self.start()

    def close(self) -> None:
        """Nothing is held."""

    def take_window(self) -> TrueWindow:
        """What the fish truly did in the latest tick."""
        return self._fish.take_window()

    def _begin(self, config: Config) -> None:
        self.config = config
        clock = VirtualClock()
        self._fish = SimulatedFish(config.plant, config.simulation, config.tick)
        self._loop = build_loop(config, self._fish.robot(), clock, Silence())
        self._puppet = Puppet(_NoParameters(), config.limits)
        self._loop.set_controller("agent", self._puppet)
        self._slots = iter(VirtualTicker(clock, config.tick))
        self._turn = self._loop.observe(next(self._slots))
