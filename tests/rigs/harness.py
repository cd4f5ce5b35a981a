"""Real loop on a simulated fish and a virtual clock."""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Self

from msgspec import structs

from fishd.assembly import build_loop, simulated_fish
from fishd.config import Config, load
from fishd.controllers import registry
from fishd.controllers.base import Controller, Limits
from fishd.core.clock import Slot, VirtualClock
from fishd.core.signals import Event, Measurement, Observation, Tick
from fishd.hardware.base import Robot
from fishd.virtual.plant.tethered import TetheredFish

PINNED_TICK = "tick=0.05"
"""Override with which tests count in ticks, whatever the default is."""


class Recorder:
    """Publisher that stores everything."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []
        self.events: list[Event] = []
        self.messages: list[Tick | Event] = []

    def tick(self, tick: Tick) -> None:
        self.ticks.append(tick)
        self.messages.append(tick)

    def event(self, event: Event) -> None:
        self.events.append(event)
        self.messages.append(event)

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


class Rig:
    """Loop on a virtual clock, with the parts that a test observes or breaks."""

    def __init__(
        self,
        *overrides: str,
        wrap: Callable[[Robot], Robot] = lambda robot: robot,
        notify: Callable[[float], None] = lambda now: None,
        stack: ExitStack | None = None,
    ) -> None:
        """stack: closes the resources of the robot"""
        self.config: Config = load(None, (PINNED_TICK, *overrides))
        self.clock = VirtualClock()
        self.recorder = Recorder()
        self.robot = wrap(self.open_robot(stack or ExitStack()))
        self.loop = build_loop(self.config, self.robot, self.clock, self.recorder, notify)
        self.index = 0

    def open_robot(self, stack: ExitStack) -> Robot:
        self.fish = simulated_fish(self.config)
        return self.fish.robot()

    def change_fin(self, thrust_coefficient: float) -> None:
        """Change the fin of the fish while it swims."""
        fish = self.fish.fish
        plant = structs.replace(fish.parameters, thrust_coefficient=thrust_coefficient)
        self.fish.fish = TetheredFish(plant, fish.state, self.config.simulation.motor)

    @property
    def now(self) -> float:
        """Latest deadline [s]."""
        return (self.index - 1) * self.config.tick

    @property
    def mode(self) -> str:
        return self.loop.supervisor.mode.value

    @property
    def reason(self) -> str | None:
        reason = self.loop.supervisor.reason
        return reason.code if reason else None

    def start(self, controller: str | Controller[Any], **parameters: Any) -> Self:
        """Select a controller, which takes over with the next tick."""
        if isinstance(controller, str):
            name = controller
            controller = registry.create(controller, parameters, self.config.limits)
        else:
            name = type(controller).__name__.lower()
        self.loop.set_controller(name, controller)
        return self

    def retune(self, **parameters: Any) -> None:
        active = self.loop.active
        active.retune(registry.merge_parameters(active.controller, active.name, parameters))

    def run(self, ticks: int = 1, *, missed: int = 0, lateness: float = 0.0) -> list[Tick]:
        """Run the loop; `missed` slots are skipped before the first of these ticks."""
        for _ in range(ticks):
            self.index += missed
            deadline = self.index * self.config.tick
            self.clock.now = max(self.clock.now, deadline + lateness)
            self.loop.tick(Slot(self.index, deadline, self.clock.now, missed))
            self.index += 1
            missed = 0
        return self.recorder.ticks[-ticks:]

    def run_for(self, seconds: float) -> list[Tick]:
        return self.run(round(seconds / self.config.tick))


LIMITS = Limits(amplitude=0.42, tick=0.05)


def observe(angle: float = 0.0, fin_velocity: float = 0.0, dt: float = 0.05) -> Observation:
    """Return an observation with only the fields that controllers use."""
    return Observation(
        time=0.0,
        dt=dt,
        fx=0.0,
        fy=0.0,
        fy_rate=0.0,
        fin_velocity=fin_velocity,
        instruction_angle=angle,
        previous_angle=angle,
        thrust=0.0,
        frequency=0.0,
    )


def commands(controller: Controller[Any], ticks: int, angle: float = 0.0) -> list[float]:
    """Return the commands of a newly activated controller, without the loop."""
    controller.activate(observe(angle))
    given = []
    for _ in range(ticks):
        angle = controller.update(observe(angle))
        given.append(angle)
    return given


class Scripted(Controller[Any]):
    """Controller that a test scripts."""

    Parameters = type(registry.create("hold", {}, LIMITS).parameters)

    def __init__(self, act: Callable[[Observation], float]) -> None:
        super().__init__(self.Parameters(), LIMITS)
        self._act = act

    def update(self, observation: Observation) -> float:
        return self._act(observation)


class Wrapped:
    """Sensor and servo that forward all calls until a test makes one of them fail."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.read_error: Exception | None = None
        self.write_error: Exception | None = None
        self.release_error: Exception | None = None
        self.suspect: str | None = None
        self.fx: float | None = None
        self.fy: float | None = None
        """Value that replaces F_y in every measurement [N]; None: true values."""
        self.delay = 0.0
        """Additional age of every measurement [s]."""
        self.log: list[float | None] = []
        """Calls of the servo: angles, and None for a release."""

    def robot(self) -> Robot:
        return Robot(
            name="wrapped",
            sensor=self,
            servo=self,
            truth=self._robot.truth,
            sensors=self._robot.sensors,
        )

    def read(self, now: float) -> Measurement:
        if self.read_error:
            raise self.read_error
        m = self._robot.sensor.read(now)
        fx = m.fx if self.fx is None else self.fx
        fy = m.fy if self.fy is None else self.fy
        return Measurement(m.time - self.delay, fx, fy, m.samples, self.suspect)

    def write(self, angle: float) -> None:
        if self.write_error:
            raise self.write_error
        self.log.append(angle)
        self._robot.servo.write(angle)

    def release(self) -> None:
        if self.release_error:
            raise self.release_error
        self.log.append(None)
        self._robot.servo.release()

    def close(self) -> None:
        self.release()


def fragile_rig(*overrides: str, kind: type[Any] = Wrapped) -> tuple[Rig, Any]:
    """Return a rig whose robot can be made to fail.

    kind: a subclass of Wrapped
    """
    made: list[Wrapped] = []

    def wrap(robot: Robot) -> Robot:
        made.append(kind(robot))
        return made[0].robot()

    return Rig(*overrides, wrap=wrap), made[0]
