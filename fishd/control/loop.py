"""The control loop: one synchronous function, `ControlLoop.tick`, that everything calls.

The daemon calls it from asyncio every period, simulation and tests from a plain `for` on a virtual
clock. It never raises: whatever goes wrong, the supervisor decides and the servo goes neutral.
Everything else here is called between two ticks, by the thread that ticks.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from msgspec.structs import replace

from fishd.control.active_controller import ActiveController, Successor, told
from fishd.control.estimators.base import Estimator
from fishd.control.estimators.lateral_sign import LateralSign
from fishd.control.estimators.live_thrust import LiveThrust
from fishd.control.guard import Guard
from fishd.control.lease import Lease
from fishd.control.reporting import Publisher, Reporter
from fishd.control.servo_output import ServoOutput
from fishd.control.servo_power import ServoPower
from fishd.control.statistics import Statistics
from fishd.control.supervisor import Mode, Supervisor
from fishd.controllers.base import Controller, Limits
from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import Clock, Slot
from fishd.core.errors import ControllerFault, FishLost, Refused, SensorError
from fishd.core.foreign_code import contained
from fishd.core.signals import Measurement, Observation
from fishd.hardware.base import Robot

if TYPE_CHECKING:
    from fishd.hardware.panel import RpiGpioPanel

UPDATE_BUDGET = 0.5
"""Share of the period that a controller's update may take."""
SETTLING = 0.1
"""How long a servo stays at neutral before its pulses end [s]."""
STALE = 2.0
"""A newest sample older than this many periods counts as a failed read."""


class Turn(Struct, frozen=True, gc=False):
    """The first half of a tick: what was read, and times at the start and after each phase [s]."""

    slot: Slot
    measurement: Measurement
    observation: Observation
    marks: tuple[float, float, float]
    power: float | None
    """Mean electrical power of the servo since the previous tick, where it is known [W]."""


class ControlLoop:
    """Reads the sensor, lets one controller choose the instruction angle, drives the servo."""

    def __init__(
        self,
        robot: Robot,
        estimator: Estimator,
        thrust: LiveThrust,
        guard: Guard,
        limits: Limits,
        clock: Clock,
        publisher: Publisher | None,
        notify: Callable[[float], None] | None = None,
        lateral_sign: LateralSign | None = None,
    ) -> None:
        """
        publisher: gets the record of every tick, and every event; with None, no record is made
        notify: called at the end of every tick with the time of its start [s, monotonic]
        """
        self.robot = robot
        self.guard = guard
        self.limits = limits
        self.supervisor = Supervisor(self._mode_changed)
        self.statistics = Statistics(limits.tick)
        self.reporter = Reporter(clock, publisher)
        self.active = ActiveController(limits, self.reporter)
        self.lease = Lease(clock.monotonic)
        self.servo = ServoOutput(robot, clock.monotonic)
        self.power = ServoPower(robot, self.reporter, limits.tick)
        self.seq = 0
        """Number of the latest tick."""
        self.applied = 0.0
        """The instruction angle that was sent last, after the guard [rad]."""
        self.neutral_for = 0.0
        """How long the instruction angle has been zero [s]."""
        self.thrust = thrust
        self.lateral_sign = lateral_sign or LateralSign()
        self.fy_corrected = False
        """Whether the latest observation has F_y with the other sign than it is measured with."""
        self.observation: Observation | None = None
        """What the latest tick observed."""
        self._estimator = estimator
        self.found_leak = estimator.found_leak
        """As of the estimator, at the latest tick [s]."""
        self._now = clock.monotonic
        self._notify = notify
        self._budget = UPDATE_BUDGET * limits.tick
        self._believed = Measurement(clock.monotonic(), 0.0, 0.0, 0)
        """The latest measurement that was to be believed."""
        self._index = -1
        self._awaited: tuple[int, str, Controller[Any], ServoCalibration | None] | None = None

    @property
    def known_thrust(self) -> tuple[float, float | None]:
        """Thrust and half of its 95 % interval [N]; while its zero is not known, as measured."""
        if self.thrust.thrust is not None:
            return self.thrust.thrust, self.thrust.error
        return (self.observation.thrust if self.observation else 0.0), None

    @property
    def settled(self) -> bool:
        """Has the servo been at neutral for so long that its pulses may end?"""
        return self.neutral_for >= SETTLING - 1e-9

    def tick(self, slot: Slot) -> None:
        """One turn of the loop."""
        self.act(self.observe(slot))

    def observe(self, slot: Slot) -> Turn:
        """First half of a tick: read and estimate. `act` must follow, with what this returns.

        Between the two, `observation` is what the controller will be shown.
        """
        started = self._now()
        self.seq += 1
        self.statistics.missed += slot.missed
        dt = (slot.index - self._index) * self.limits.tick
        self._index = slot.index
        if self._awaited:
            self._begin_awaited(*self._awaited)
        if self.robot.panel:
            self._attend_panel(self.robot.panel, slot)
        if self.lease.active:
            self.expire_lease()
        measurement = self._read(slot)
        power = self.power.read(slot.deadline) if self.power.metered else None
        read = self._now()
        suspect = bool(measurement.suspect)
        observation = self._estimate(self._once_more() if suspect else measurement, slot, dt)
        if not (self.supervisor.failures and self.supervisor.sensor_lost):
            observation = self._follow_thrust(observation, suspect)
            if self.limits.tethered:
                self._watch_sign(observation, measurement.fy, suspect)
        self.observation = observation
        return Turn(slot, measurement, observation, (started, read, self._now()), power)

    def act(self, turn: Turn) -> None:
        """Second half of a tick: let the controller choose, drive the servo, publish."""
        slot, observation = turn.slot, turn.observation
        started, read, estimated = turn.marks
        before, self.applied = self.applied, self._update(observation, estimated)
        moved = before or self.applied
        self.neutral_for = 0.0 if moved else self.neutral_for + observation.dt
        updated = self._now()
        self._write(neutral=not moved and self.settled)
        written = self._now()
        if self.reporter.publishes:
            self._publish(turn, written)
        marks = (started, read, estimated, updated, written, self._now())
        late = self.statistics.add(self.seq, slot.now - slot.deadline, slot.missed, marks)
        if late:
            self.reporter.event("overrun", late, "warning", seq=self.seq, missed=slot.missed)
            self.supervisor.overran(self.seq)
        if self._notify:
            self._notify(started)

    def warm_up(self) -> None:
        """Let the active controller warm up for the next tick, which is imminent."""
        try:
            self.active.warm_up()
        except Exception as error:
            self._fail("controller-error", f"controller {self.active.name} failed", error)

    def set_controller(self, name: str, controller: Controller[Any]) -> None:
        """Make a ready-made controller the active one, from the next tick on.

        Raises `Refused` while a fault or an emergency stop is latched.
        """
        self.supervisor.check_startable()
        if self._is_refused(controller):
            raise Refused("fy-reversed", self.lateral_sign.complaint)
        self._await_nobody()
        self.active.replace(name, controller)
        active = self.active
        self.reporter.controller("controller", name, active.parameters, active.parameter_units)
        self.supervisor.start()

    def set_controller_after(self, seconds: float, name: str, controller: Controller[Any]) -> None:
        """Make it the active one after so long at rest; whatever else is asked for comes first.

        So does another calibration of the servo: somebody tries it out, and the tail must wait.
        """
        rest = math.ceil(seconds / self.limits.tick - 1e-9)
        self._awaited = (rest, name, controller, self._servo_calibration)

    def forget_force(self, *, scale: bool) -> None:
        """The force sensor has another zero: find it anew; scale: all the rest is another, too."""
        self._estimator.forget_zero()
        if scale:
            self.thrust.forget()
            self.lateral_sign.forget()
        else:
            self.thrust.forget_zero()
            self.lateral_sign.rest()

    def stop(self) -> None:
        """Fade to neutral and stay there; after a fault or estop there is nothing left to stop."""
        self._await_nobody()
        self.supervisor.stop()

    def expire_lease(self) -> None:
        """Where the lease, which is active, has run out: fade to neutral what its holder began."""
        swims = self.supervisor.mode is Mode.RUNNING and self.lease.drives
        former = self.lease.run_out(moving=swims)
        if former and self.lease.expired:
            does = "the fish fades to neutral" if swims else "nothing that it began swims"
            message = f"{self.lease.expired.message}: {does}"
            name, host, pid = former.name, former.host, former.pid
            self.reporter.event("lease-expired", message, "warning", name=name, host=host, pid=pid)
            if swims:
                self.stop()

    def clear_fault(self) -> None:
        """Leave mode fault or estop for idle: the servo gets pulses again."""
        self.supervisor.clear()

    def estop(self, message: str) -> None:
        """Stop the pulses now, without waiting for a tick."""
        self.supervisor.estop(message)

    def close(self) -> None:
        """Let go of the active controller; nothing ticks after this."""
        self._await_nobody()
        self.active.rest()

    @property
    def _servo_calibration(self) -> ServoCalibration | None:
        return self.robot.calibrated.servo.calibration if self.robot.calibrated else None

    def _begin_awaited(
        self, rest: int, name: str, controller: Controller[Any], servo: ServoCalibration | None
    ) -> None:
        if self._servo_calibration is not servo:
            self._await_nobody()
            message = f"{name} does not begin by itself any more: the servo has another calibration"
            self.reporter.event("calibration", message, "warning")
        elif self.seq > rest:
            self._awaited = None
            try:
                self.set_controller(name, controller)
            except Exception as error:
                self._fail("controller-error", f"controller {name} cannot begin", error)

    def _await_nobody(self) -> None:
        if self._awaited:
            _, name, controller, _ = self._awaited
            self._awaited = None
            self.active.dispose(controller, f"{name}, which was to begin,")

    def _mode_changed(self, before: Mode) -> None:
        """All that a change of mode leads to, whatever caused it."""
        mode = self.supervisor.mode
        if mode is Mode.ESTOP:
            self._write(neutral=False)  # first of all
        self._await_nobody()
        if reason := self.supervisor.reason:
            self.lease.end(f"{mode}: {reason.message}")
        if mode is not Mode.RUNNING:
            self.active.rest()
            self._estimator.rest()
        self.reporter.mode(before, mode, self.supervisor.reason)

    def _fail(self, code: str, what: str, error: Exception) -> None:
        """Latch a fault; an error while one is latched is logged all the same, once."""
        self.supervisor.fail(code, self.reporter.problem(what, error))

    def _attend_panel(self, panel: "RpiGpioPanel", slot: Slot) -> None:
        """Show the mode on the operator's panel, and stop at once while its button is pressed."""
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
        except Exception as error:
            if isinstance(error, FishLost):
                self._fail("fish-lost", "there is nothing to read any more", error)
            problem = f"the force sensor cannot be read: {text.named(error)}"
            measurement = self._once_more()
        else:
            if measurement.suspect or self.supervisor.failures:
                self.supervisor.check("sensor-range", measurement.suspect)
            if not measurement.samples:  # it says again what may have been suspect
                measurement = replace(measurement, fx=self._believed.fx, fy=self._believed.fy)
        if not measurement.suspect:
            self._believed = measurement
        age = slot.now - measurement.time
        if problem is None and age > STALE * self.limits.tick:
            problem = f"the newest force sample is {age * 1e3:.0f} ms old"
        if problem or self.supervisor.failures:
            self.supervisor.check("sensor-stale", problem)
        return measurement

    def _once_more(self) -> Measurement:
        """What was to be believed last, of which nothing is new."""
        return replace(self._believed, samples=0, extremes=None)

    def _estimate(self, measurement: Measurement, slot: Slot, dt: float) -> Observation:
        try:
            if self.fy_corrected is not self.lateral_sign.corrected:
                self._estimator.reverse_fy()
                self.fy_corrected = self._estimator.fy_corrected
            known = self.thrust.factor
            seen = self._estimator.update(measurement, self.applied, slot.deadline, dt, known)
            if not math.isfinite(seen.fy_rate + seen.fin_velocity + seen.thrust):
                raise ArithmeticError(f"it gave a fin velocity of {seen.fin_velocity}")
            return seen
        except Exception as error:
            self._fail("estimate-error", "the estimator failed", error)
            fx, fy, angle = measurement.fx, measurement.fy, self.applied
            return Observation(slot.deadline, dt, fx, fy, 0.0, 0.0, angle, angle, 0.0, 0.0)

    def _follow_thrust(self, observation: Observation, suspect: bool) -> Observation:
        """Add what is known of the thrust; where that fails, it begins anew.

        suspect: is the force of this tick not to be believed?
        """
        try:
            if self._estimator.found_leak != self.found_leak:
                self.found_leak = self._estimator.found_leak
                self.thrust.forget_factor()
            running = self.supervisor.mode is Mode.RUNNING
            self.thrust.update(observation, running, self.active.wave)
            if suspect:
                self.thrust.interrupt()
            known = self.thrust.factor
        except ArithmeticError as error:
            self.reporter.problem("the thrust cannot be told, and is found anew", error)
            self.thrust.forget()
            known = None
        factor, ci95 = known or (None, None)
        if factor == observation.thrust_factor and ci95 == observation.thrust_factor_error:
            return observation
        return replace(observation, thrust_factor=factor, thrust_factor_error=ci95)

    def _watch_sign(self, observation: Observation, fy: float, suspect: bool) -> None:
        """Notice, when the tail sets off, that F_y is reversed.

        fy: as it is measured [N]
        """
        if suspect:
            self.lateral_sign.rest()
            return
        try:
            if self.lateral_sign.update(observation, fy) and self.lateral_sign.reversed:
                self.reporter.event("calibration", self.lateral_sign.complaint, "warning")
                if self._is_refused(self.active.controller):
                    self.supervisor.fail("fy-reversed", self.lateral_sign.complaint)
        except ArithmeticError as error:
            self.reporter.problem("the sign of F_y cannot be told, and is found anew", error)
            self.lateral_sign.forget()

    def _is_refused(self, controller: Controller[Any]) -> bool:
        # `is not False`: what another package has made of it raises nothing here.
        return self.lateral_sign.refuses and type(controller).uses_lateral_force is not False

    def _update(self, observation: Observation, began: float, *, may_succeed: bool = True) -> float:
        """The angle to apply: the controller's after the guard, or the next step to neutral [rad].

        began: when the controller's time begins [s, monotonic]
        may_succeed: may a controller that gives up name another one? Once in a tick.
        """
        if self.supervisor.mode is Mode.ESTOP:
            return self.applied
        if self.supervisor.mode is not Mode.RUNNING:
            return self.guard.fade(self.applied)
        name = self.active.name
        try:
            command = contained(self.active.update, observation)
            applied = self.guard.apply(command, self.applied)
        except ControllerFault as error:
            code, successor = told(error)
            if successor and may_succeed:
                self._succeed(error, code, successor)
            else:
                self._fail(code, f"controller {name} gave up", error)
        except Exception as error:
            self._fail("controller-error", f"controller {name} failed", error)
        else:
            seconds = self._now() - began
            if seconds > self._budget or self.supervisor.failures:
                self._check_budget(name, seconds)
            return applied
        return self._update(observation, self._now(), may_succeed=False)

    def _succeed(self, error: ControllerFault, code: str, successor: Successor) -> None:
        before = self.active.name
        try:
            self.active.succeed(error, code, successor)
            self.supervisor.start()
        except Exception as problem:
            what = f"{successor[0]}, who was to follow {before}, failed"
            self._fail("controller-error", what, problem)

    def _check_budget(self, name: str, seconds: float) -> None:
        budget, problem = self._budget, None
        if seconds > budget:
            took = f"{seconds * 1e3:.1f} ms of its {budget * 1e3:.1f} ms"
            problem = f"controller {name} took {took}"
        self.supervisor.check("controller-slow", problem)

    def _write(self, neutral: bool) -> None:
        """Send the applied angle, or release the servo, as the mode demands."""
        if self.servo.counts_down and (problem := self.servo.why_at_rest()):
            self.applied = 0.0  # where the servo is: to begin elsewhere would make it jump
            neutral = True
            self.supervisor.fail("overrun", problem)
        latched, lost = self.supervisor.reason, self.servo.lost
        try:
            self.servo.command(self.supervisor.mode, self.applied, neutral)
            if lost:
                self.reporter.event("servo", "the servo can be reached again")
        except Exception as error:
            if problem := self.servo.why_silent():  # in the write itself: so it failed
                self.supervisor.fail("overrun", problem)
            self._fail("servo-link", "the servo cannot be driven", error)
            if latched and not lost:  # which the fault or the stop that is latched does not say
                message = f"it may still have pulses, and cannot be released: {text.named(error)}"
                self.reporter.event("servo", message, "error")

    def _publish(self, turn: Turn, now: float) -> None:
        try:
            self.reporter.tick(self, turn, now)
        except Exception as error:
            self._fail("publish-error", "telemetry cannot be published", error)
