"""The control loop: one synchronous function, `ControlLoop.tick`, that everything calls.

The daemon calls it from asyncio every period, simulation and tests from a plain `for` on a virtual
clock. It never raises: whatever goes wrong, the supervisor decides and the servo goes neutral.
Everything else here is called between two ticks, by the thread that ticks.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd import text
from fishd.clock import Clock, Slot
from fishd.contained import contained
from fishd.controllers.base import Controller, Limits
from fishd.controllers.hold import Hold, HoldParameters
from fishd.drive import Drive
from fishd.errors import ControllerFault, SensorError
from fishd.estimators.lateral_force import LateralForceEstimator
from fishd.guard import Guard
from fishd.hardware.base import Robot
from fishd.reporting import Publisher, Reporter, why_overrun, why_silent, why_skipped
from fishd.signals import Measurement, Observation, Reason
from fishd.statistics import Statistics
from fishd.supervisor import Mode, Supervisor

UPDATE_BUDGET = 0.5
"""Share of the period that a controller's update may take."""
SETTLING = 0.1
"""How long a servo stays at neutral before its pulses end [s]."""
STALE = 2.0
"""A newest sample older than this many periods counts as a failed read."""


class Turn(NamedTuple):
    """Half a turn of the loop: what was read, and times at the start and after each phase [s]."""

    slot: Slot
    measurement: Measurement
    observation: Observation
    marks: tuple[float, float, float]


class ControlLoop:
    """Reads the sensor, lets one controller choose the instruction angle, drives the servo."""

    def __init__(
        self,
        robot: Robot,
        estimator: LateralForceEstimator,
        guard: Guard,
        limits: Limits,
        clock: Clock,
        publisher: Publisher,
        notify: Callable[[float], None] = lambda now: None,
    ) -> None:
        """notify: called at the end of every tick with the time of its start [s, monotonic]"""
        self.robot = robot
        self.limits = limits
        self.supervisor = Supervisor()
        self.statistics = Statistics()
        self.reporter = Reporter(clock, publisher)
        self.seq = 0
        """Number of the latest tick."""
        self.applied = 0.0
        """The instruction angle in force [rad]."""
        self.neutral_for = 0.0
        """How long the instruction angle has been zero [s]."""
        self.observation: Observation | None = None
        """What the latest tick observed."""
        self.controller: Controller[Any] = Hold(HoldParameters(), limits)
        self.controller_name = "hold"
        self.parameters = _plain(self.controller)
        """Those of the controller in command, as JSON has them."""
        self.fallback: Reason | None = None
        """Why the controller in command took over from the one that was put there, if it did."""
        self._fresh = False
        self._estimator = estimator
        self.guard = guard
        self._now = clock.monotonic
        self._drive = Drive(robot, clock.monotonic)
        self._notify = notify
        self._measurement = Measurement(clock.monotonic(), 0.0, 0.0, 0)
        self._index = -1
        self._overran = False

    @property
    def servo_on(self) -> bool:
        """False once the servo is known to get no pulses."""
        return self._drive.on

    @property
    def servo_lost(self) -> bool:
        """True while the servo cannot be reached; with `servo_on`, it may still have pulses."""
        return self._drive.lost

    def tick(self, slot: Slot) -> None:
        """One turn of the loop."""
        self.act(self.observe(slot))

    def observe(self, slot: Slot) -> Turn:
        """First half of a turn: read and estimate. `act` must follow, with what this returns.

        Between the two, `observation` is what the controller will be shown.
        """
        now = self._now
        started = now()
        self.seq += 1
        dt = (slot.index - self._index) * self.limits.tick
        self._index = slot.index
        self.statistics.missed += slot.missed
        self._attend_panel(slot)
        measurement = self._read(slot)
        read = now()
        observation = self._estimate(measurement, slot, dt)
        self.observation = observation
        return Turn(slot, measurement, observation, (started, read, now()))

    def act(self, turn: Turn) -> None:
        """Second half of a turn: let the controller choose, drive the servo, publish."""
        now = self._now
        slot, measurement, observation, (started, read, estimated) = turn
        self.applied = self._update(observation)
        self.neutral_for = 0.0 if self.applied else self.neutral_for + observation.dt
        updated = now()
        self._write(neutral=self.neutral_for > SETTLING)
        written = now()
        self._publish(slot, measurement, observation, written - started)
        marks = (started, read, estimated, updated, written, now())
        self.statistics.add(self.seq, slot.now - slot.deadline, marks)
        self._check_overrun(slot, marks)
        self._notify(started)

    def rehearse(self) -> None:
        """Let the controller in command warm up for the next tick, which is imminent."""
        try:
            contained(self.controller.rehearse)
        except Exception as error:
            self._fail("controller-error", f"controller {self.controller_name} failed", error)

    def set_controller(self, name: str, controller: Controller[Any]) -> None:
        """Put a ready-made controller in command from the next tick on.

        Raises `Refused` while a fault or an emergency stop is latched.
        """
        before = self.supervisor.mode
        self.supervisor.check_startable()
        self._swap(name, controller, fresh=True)
        self.supervisor.start()
        self.reporter.controller(name, self.parameters, "controller", "takes over with")
        self.reporter.mode(before, self.supervisor)

    def retune(self, parameters: Struct) -> None:
        """Give the controller in command new, already checked parameters; raises what it raises."""
        contained(self.controller.retune, parameters)
        self.parameters = _plain(self.controller)
        self.reporter.controller(
            self.controller_name, self.parameters, "parameters", "goes on with"
        )

    def stop(self) -> None:
        """Fade to neutral and stay there; after a fault or estop there is nothing left to stop."""
        before = self.supervisor.mode
        self.supervisor.stop()
        self._rest()
        self.reporter.mode(before, self.supervisor)

    def clear_fault(self) -> None:
        """Leave mode fault or estop for idle: the servo gets pulses again."""
        before = self.supervisor.mode
        self.supervisor.clear()
        self.reporter.mode(before, self.supervisor)

    def estop(self, message: str) -> None:
        """Stop the pulses now, without waiting for a tick."""
        before = self.supervisor.mode
        self.supervisor.estop(message)
        self._write(neutral=False)  # first of all
        self._rest()
        self.reporter.mode(before, self.supervisor, level="error")

    def close(self) -> None:
        """Let go of the controller in command; nothing ticks after this."""
        self._rest()

    def _rest(self) -> None:
        """Put `hold` in command, at neutral."""
        self._swap("hold", Hold(HoldParameters(), self.limits), fresh=False)
        self._estimator.rest()

    def _swap(self, name: str, controller: Controller[Any], *, fresh: bool) -> None:
        former, self.parameters = self.controller, _plain(controller)
        self.controller_name, self.controller, self._fresh = name, controller, fresh
        self.fallback = None
        try:
            contained(former.close)
        except Exception as error:
            self.reporter.problem(f"the controller before {name} could not be closed", error)

    def _attend_panel(self, slot: Slot) -> None:
        """Show the mode on the operator's panel, and stop at once while its button is pressed."""
        panel = self.robot.panel
        if panel is None:
            return
        try:
            if panel.update(self.supervisor.mode.value, slot.now):
                self.estop("the E-stop button is pressed")
        except Exception as error:
            self._fail("estop-button", "the E-stop button cannot be read", error)

    def _read(self, slot: Slot) -> Measurement:
        problem = None
        try:
            measurement = self.robot.sensor.read(slot.deadline)
            if not math.isfinite(measurement.fx + measurement.fy):
                raise SensorError(f"it gave ({measurement.fx}, {measurement.fy}) N")
            if self.supervisor.suspect(measurement.suspect):
                self._fall()
        except Exception as error:
            problem = f"the force sensor cannot be read: {text.named(error)}"
            measurement = self._measurement  # once more, and nothing of it is new
        self._measurement = replace(measurement, samples=0, suspect="", extremes=None)
        age = slot.now - measurement.time
        if problem is None and age > STALE * self.limits.tick:
            problem = f"the newest force sample is {age * 1e3:.0f} ms old"
        if self.supervisor.sensor(problem):
            self._fall()
        return measurement

    def _estimate(self, measurement: Measurement, slot: Slot, dt: float) -> Observation:
        try:
            return self._estimator.update(measurement, self.applied, slot.deadline, dt)
        except Exception as error:
            self._fail("estimate-error", "the estimator failed", error)
            fx, fy, angle = measurement.fx, measurement.fy, self.applied
            return Observation(slot.deadline, dt, fx, fy, 0.0, 0.0, angle, angle, 0.0, 0.0)

    def _update(self, observation: Observation, *, may_succeed: bool = True) -> float:
        """The angle to apply: the controller's after the guard, or the next step to neutral.

        may_succeed: may a controller that gives up name another one? Once in a tick.
        """
        mode = self.supervisor.mode
        if mode is Mode.ESTOP:
            return self.applied
        if mode is not Mode.RUNNING:
            return self.guard.fade(self.applied)
        started = self._now()
        try:
            if self._fresh:
                contained(self.controller.activate, observation)
                self._fresh = False
            command = contained(self.controller.update, observation)
            applied = contained(self.guard.apply, command, self.applied)
        except ControllerFault as error:
            code, successor = _told(error)
            if successor and may_succeed:
                return self._succeed(error, *successor, observation)
            self._fail(code, f"controller {self.controller_name} gave up", error)
            return self.guard.fade(self.applied)
        except Exception as error:
            self._fail("controller-error", f"controller {self.controller_name} failed", error)
            return self.guard.fade(self.applied)
        budget = UPDATE_BUDGET * self.limits.tick
        if self.supervisor.update_time(self._now() - started, budget, self.controller_name):
            self._fall()
        return applied

    def _succeed(
        self, error: ControllerFault, name: str, controller: Controller[Any], seen: Observation
    ) -> float:
        """The controller in command has named who takes over: in this very tick."""
        before = self.controller_name
        try:
            self._swap(name, controller, fresh=True)
        except Exception as problem:
            self._fail("controller-error", f"{name}, who was to follow {before}, failed", problem)
            return self.guard.fade(self.applied)
        why = text.line(f"{before} lost command: {text.said(error)}")
        self.fallback = Reason(_told(error)[0], why)
        self.reporter.fallback(before, name, self.parameters, self.fallback)
        return self._update(seen, may_succeed=False)

    def _write(self, neutral: bool) -> None:
        """Send the angle in force, or release the servo, as the mode demands."""
        if silence := self._drive.silence():
            self.applied = 0.0  # where the servo is: to begin elsewhere would make it jump
            neutral = True
            if self.supervisor.fail("overrun", why_silent(silence)):
                self._fall()
        latched, lost = self.supervisor.reason, self._drive.lost
        try:
            self._drive.command(self.supervisor.mode, self.applied, neutral)
            if lost:
                self.reporter.event("servo", "the servo can be reached again")
        except Exception as error:
            self._fail("servo-link", "the servo cannot be driven", error)
            if latched and not lost:  # which the fault or the stop that is latched does not say
                message = f"it may still have pulses, and cannot be released: {text.named(error)}"
                self.reporter.event("servo", message, "error")

    def _publish(
        self, slot: Slot, measurement: Measurement, observation: Observation, busy: float
    ) -> None:
        try:
            self.reporter.tick(
                slot,
                measurement,
                observation,
                self.robot.truth() if self.robot.truth else None,
                seq=self.seq,
                mode=self.supervisor.mode,
                controller=self.controller_name,
                angle=self.applied,
                servo_on=self.servo_on,
                busy=busy,
                missed=self.statistics.missed,
            )
        except Exception as error:
            self._fail("publish-error", "telemetry cannot be published", error)

    def _check_overrun(self, slot: Slot, marks: tuple[float, ...]) -> None:
        """Report a tick that took too long, or slots that were lost for another reason."""
        message = why_overrun(self.seq, marks, self.limits.tick)
        self.statistics.overruns += message is not None
        if not message and not self._overran:
            message = why_skipped(self.seq, slot.missed)
        self._overran = message is not None
        if message:
            self.reporter.event("overrun", message, "warning", seq=self.seq, missed=slot.missed)
        if self.supervisor.overrun(self._overran):
            self._fall()

    def _fail(self, code: str, what: str, error: Exception) -> None:
        """Latch a fault; an error while one is latched is logged all the same, once."""
        if self.supervisor.fail(code, self.reporter.problem(what, error)):
            self._fall()

    def _fall(self) -> None:
        """The supervisor has just latched a fault: put `hold` in command and tell everyone."""
        self._rest()
        self.reporter.fault(self.supervisor)


def _told(error: ControllerFault) -> tuple[str, tuple[str, Controller[Any]] | None]:
    """Code and successor of a fault, whatever a subclass has made of them."""

    def told() -> tuple[str, tuple[str, Controller[Any]] | None]:
        code, successor = error.code, error.successor
        if type(code) is not str:
            code = "controller-error"
        if type(successor) is tuple and type(successor[0]) is str:
            name, controller = successor
            if isinstance(controller, Controller):
                return code, (name, controller)
        return code, None

    try:
        return contained(told)
    except Exception:
        return "controller-error", None


def _plain(controller: Controller[Any]) -> dict[str, Any]:
    """The parameters of a controller as JSON has them; raises what it raises, or an Exception."""

    def plain() -> dict[str, Any]:
        encoded = msgspec.json.encode(msgspec.structs.asdict(controller.parameters))
        return msgspec.json.decode(encoded, type=dict[str, Any])

    return contained(plain)
