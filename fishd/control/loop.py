"""The control loop: one synchronous function, `ControlLoop.tick`, for daemon and simulation alike.

The daemon calls it from asyncio every period, simulation and tests from a plain `for` on a virtual
clock. It never raises: whatever goes wrong, the supervisor decides and the servo goes neutral.
All other methods are called between two ticks, by the thread that calls `tick`.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from msgspec.structs import asdict

from fishd.control.active_controller import ActiveController, Successor, fault_and_successor
from fishd.control.estimators.base import Estimator
from fishd.control.estimators.lateral_sign import LateralSign
from fishd.control.estimators.live_thrust import LiveThrust
from fishd.control.guard import Guard
from fishd.control.lease import Lease
from fishd.control.perception import Perception
from fishd.control.readings import Readings
from fishd.control.reporting import Reporter
from fishd.control.servo import ServoOutput
from fishd.control.statistics import Statistics
from fishd.control.supervisor import Mode, Supervisor
from fishd.controllers.base import Controller, Limits
from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import Clock, Slot
from fishd.core.errors import ControllerFault
from fishd.core.foreign_code import call_foreign
from fishd.core.loop_settings import LoopSettings
from fishd.core.signals import Measurement, Observation, Publisher, Tick
from fishd.hardware.base import Robot

if TYPE_CHECKING:
    from fishd.hardware.panel import Panel

UPDATE_BUDGET = 0.5
"""Largest fraction of the period that an update of the controller may take."""
SETTLE_TIME_S = 0.1
"""Time that a servo stays at neutral before its pulses end [s]."""


class TickInputs(Struct, frozen=True, gc=False):
    """The result of the first half of a tick: what was read, and what follows from it."""

    slot: Slot
    measurement: Measurement
    observation: Observation
    marks: tuple[float, float, float]
    """Times at the start of the tick, after the read and after the estimate [s, monotonic]."""


class ControlLoop:
    """The loop that reads the sensor, lets a controller choose the angle and drives the servo."""

    def __init__(
        self,
        robot: Robot,
        estimator: Estimator,
        thrust: LiveThrust,
        lateral_sign: LateralSign,
        guard: Guard,
        settings: LoopSettings,
        limits: Limits,
        clock: Clock,
        publisher: Publisher | None,
        notify: Callable[[float], None] | None = None,
    ) -> None:
        """
        publisher: receives the record of every tick, and every event; None: ticks are not recorded
        notify: called at the end of every tick with the time of its start [s, monotonic]
        """
        self.robot = robot
        self.guard = guard
        self.settings = settings
        self.limits = limits
        self.supervisor = Supervisor(self._mode_changed)
        self.statistics = Statistics(settings.tick)
        self.reporter = Reporter(clock, publisher)
        self.active = ActiveController(limits, self.reporter)
        self.lease = Lease(clock.monotonic)
        self.servo = ServoOutput(robot, clock.monotonic)
        self.readings = Readings(
            robot.sensors, self.reporter, self.supervisor, settings.tick, clock.monotonic()
        )
        self.seq = 0
        """Sequence number of the latest tick."""
        self.instruction_angle = 0.0
        """Instruction angle that was sent last, after the guard [rad]."""
        self.neutral_for = 0.0
        """Time since the instruction angle became zero [s]."""
        self.perception = Perception(
            estimator,
            thrust,
            lateral_sign,
            robot.sensor,
            self.active,
            self.supervisor,
            self.reporter,
            limits,
            clock.monotonic(),
        )
        self._now, self._wall = clock.monotonic, clock.wall
        self._publisher = publisher
        self._mode = self.supervisor.mode.value
        self._notify = notify
        self._budget = UPDATE_BUDGET * settings.tick
        self._index = -1
        self._pending: tuple[int, str, Controller[Any], ServoCalibration | None] | None = None

    @property
    def has_settled(self) -> bool:
        """Whether the servo has been at neutral for `SETTLE_TIME_S`, so that its pulses may end."""
        return self.neutral_for >= SETTLE_TIME_S - 1e-9

    def tick(self, slot: Slot) -> None:
        """Run one tick of the loop."""
        self.act(self.observe(slot))

    def observe(self, slot: Slot) -> TickInputs:
        """Run the first half of a tick: read and estimate. `act` must follow, with the result.

        Between the two, `perception.observation` is the one that the controller will receive.
        """
        started = self._now()
        self.seq += 1
        self.statistics.missed += slot.missed
        dt = (slot.index - self._index) * self.settings.tick
        self._index = slot.index
        if self._pending:
            self._start_pending(*self._pending)
        if self.robot.panel:
            self._attend_panel(self.robot.panel, slot)
        if self.lease.active:
            self.expire_lease()
        measurement = self.perception.read(slot)
        readings = self.readings.read(slot.deadline) if self.readings.sensors else None
        read = self._now()
        observation = self.perception.observe(
            measurement, slot, dt, self.instruction_angle, readings
        )
        return TickInputs(slot, measurement, observation, (started, read, self._now()))

    def act(self, inputs: TickInputs) -> None:
        """Run the second half of a tick: let the controller choose, drive the servo, publish."""
        slot, observation = inputs.slot, inputs.observation
        started, read, estimated = inputs.marks
        before, self.instruction_angle = (
            self.instruction_angle,
            self._update(observation, estimated),
        )
        moved = before or self.instruction_angle
        self.neutral_for = 0.0 if moved else self.neutral_for + observation.dt
        updated = self._now()
        self._write(neutral=not moved and self.has_settled)
        written = self._now()
        if self._publisher is not None:
            self._publish(self._publisher, inputs, written)
        marks = (started, read, estimated, updated, written, self._now())
        late = self.statistics.add(self.seq, slot.now - slot.deadline, slot.missed, marks)
        if late:
            self.reporter.event("overrun", late, "warning", seq=self.seq, missed_slots=slot.missed)
            self.supervisor.note_overrun(self.seq)
        if self._notify:
            self._notify(started)

    def set_controller(self, name: str, controller: Controller[Any]) -> None:
        """Make a controller the active one, from the next tick on.

        Raises `Refused` while a fault or an emergency stop is latched.
        """
        self.supervisor.check_startable()
        self.perception.check_usable(controller)
        self._cancel_pending()
        self.active.replace(name, controller)
        active = self.active
        self.reporter.controller("controller", name, active.parameters, active.parameter_units)
        self.supervisor.start()

    def set_controller_after(self, seconds: float, name: str, controller: Controller[Any]) -> None:
        """Make a controller the active one after some seconds at rest [s].

        Any other request cancels that. So does another calibration of the servo, since the operator
        tries it out then, and the tail must not move.
        """
        rest = math.ceil(seconds / self.settings.tick - 1e-9)
        self._pending = (rest, name, controller, self._servo_calibration)

    @property
    def pending(self) -> str | None:
        """Name of the controller that is to start after a time at rest; None if there is none."""
        return self._pending[1] if self._pending else None

    def stop(self) -> None:
        """Fade to neutral and stay there; has no effect while a fault or estop is latched."""
        self._cancel_pending()
        self.supervisor.stop()

    def expire_lease(self) -> None:
        """End the active lease if it has expired; fade to neutral if its holder drives the fish."""
        swims = self.supervisor.mode is Mode.RUNNING and self.lease.drives
        former = self.lease.end_if_expired(moving=swims)
        if former and self.lease.expired:
            effect = "the fish fades to neutral" if swims else "none of its controllers is active"
            message = f"{self.lease.expired.message}: {effect}"
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
        """Close the active controller; no tick may follow."""
        self._cancel_pending()
        self.active.activate_hold()

    @property
    def _servo_calibration(self) -> ServoCalibration | None:
        return self.robot.calibrated.servo.calibration if self.robot.calibrated else None

    def _start_pending(
        self, rest: int, name: str, controller: Controller[Any], servo: ServoCalibration | None
    ) -> None:
        if self._servo_calibration is not servo:
            self._cancel_pending()
            message = f"{name} will not start by itself: the servo has another calibration now"
            self.reporter.event("calibration", message, "warning")
        elif self.seq > rest:
            self._pending = None
            try:
                self.set_controller(name, controller)
            except Exception as error:
                self._fail("controller-error", f"controller {name} cannot be started", error)

    def _cancel_pending(self) -> None:
        if self._pending:
            _, name, controller, _ = self._pending
            self._pending = None
            self.active.close_controller(controller, f"the pending controller {name}")

    def _mode_changed(self, before: Mode) -> None:
        """Handle a change of mode, whatever caused it."""
        mode = self.supervisor.mode
        if mode is Mode.ESTOP:
            self._write(neutral=False)  # before anything else
        self._cancel_pending()
        if reason := self.supervisor.reason:
            self.lease.end(f"{mode}: {reason.message}")
        if mode is not Mode.RUNNING:
            self.active.activate_hold()
            self.perception.rest()
        self._mode = mode.value
        self.reporter.mode(before, mode, self.supervisor.reason)

    def _fail(self, code: str, what: str, error: Exception) -> None:
        """Latch a fault, and log its error once, also while another fault is latched."""
        self.supervisor.fail(code, self.reporter.problem(what, error))

    def _attend_panel(self, panel: "Panel", slot: Slot) -> None:
        """Show the mode on the operator's panel, and stop at once while its button is pressed."""
        try:
            if panel.update(self.supervisor.mode.value, slot.now):
                self.estop("the E-stop button is pressed")
        except Exception as error:
            self._fail("estop-button", "the E-stop button cannot be read", error)

    def _update(
        self, observation: Observation, began: float, *, may_hand_over: bool = True
    ) -> float:
        """Return the instruction angle to send [rad]: the controller's, or a step to neutral.

        began: start of the time that the controller may take [s, monotonic]
        may_hand_over: whether a controller that gives up may name a successor: once in a tick
        """
        if self.supervisor.mode is Mode.ESTOP:
            return self.instruction_angle
        if self.supervisor.mode is not Mode.RUNNING:
            return self.guard.fade(self.instruction_angle)
        name = self.active.name
        try:
            chosen = call_foreign(self.active.update, observation)
            permitted = self.guard.apply(chosen, self.instruction_angle)
        except ControllerFault as error:
            code, successor = fault_and_successor(error)
            if successor and may_hand_over:
                self._hand_over(error, code, successor)
            else:
                self._fail(code, f"controller {name} gave up", error)
        except Exception as error:
            self._fail("controller-error", f"controller {name} failed", error)
        else:
            seconds = self._now() - began
            if seconds > self._budget or self.supervisor.failures:
                self._check_budget(name, seconds)
            return permitted
        return self._update(observation, self._now(), may_hand_over=False)

    def _hand_over(self, error: ControllerFault, code: str, successor: Successor) -> None:
        before = self.active.name
        try:
            self.active.hand_over(error, code, successor)
            self.supervisor.start()
        except Exception as problem:
            what = f"{successor[0]}, the successor of {before}, failed"
            self._fail("controller-error", what, problem)

    def _check_budget(self, name: str, seconds: float) -> None:
        budget, problem = self._budget, None
        if seconds > budget:
            durations = f"{seconds * 1e3:.1f} ms of its {budget * 1e3:.1f} ms"
            problem = f"controller {name} took {durations}"
        self.supervisor.check("controller-slow", problem)

    def _write(self, neutral: bool) -> None:
        """Send the instruction angle, or release the servo, as the mode demands."""
        if self.servo.counts_down and (problem := self.servo.why_at_rest()):
            self.instruction_angle = 0.0  # the servo is there; another start would make it jump
            neutral = True
            self.supervisor.fail("overrun", problem)
        latched, lost = self.supervisor.reason, self.servo.lost
        try:
            self.servo.drive(self.supervisor.mode, self.instruction_angle, neutral)
            if lost:
                self.reporter.event("servo", "the servo can be reached again")
        except Exception as error:
            if problem := self.servo.why_silent():  # the write itself took too long
                self.supervisor.fail("overrun", problem)
            self._fail("servo-link", "the servo cannot be driven", error)
            if latched and not lost:  # the latched reason does not say that
                message = (
                    "it may still have pulses, and cannot be released: "
                    f"{text.describe_error(error)}"
                )
                self.reporter.event("servo", message, "error")

    def _publish(self, publisher: Publisher, inputs: TickInputs, now: float) -> None:
        try:
            publisher.tick(self._record(inputs, now))
        except Exception as error:
            self._fail("publish-error", "telemetry cannot be published", error)

    def _record(self, inputs: TickInputs, now: float) -> Tick:
        """Return the record of a tick: the fields of the loop, and those of its parts.

        now: time after the servo was driven [s, monotonic]
        """
        slot, measurement = inputs.slot, inputs.measurement
        parts = self.perception.telemetry(measurement, inputs.observation)
        if readings := inputs.observation.readings:
            parts["readings"] = readings
        if quantities := self.active.quantities:
            parts["quantities"] = quantities
        if self.robot.truth:
            truth = self.robot.truth()
            parts |= {"alpha": truth.alpha, "alpha_rate": truth.alpha_rate, "phi": truth.phi}
            if truth.course:
                parts |= asdict(truth.course)
        return Tick(
            t=self._wall(),
            seq=self.seq,
            mode=self._mode,
            controller=self.active.name,
            phi_c=self.instruction_angle,
            servo_on=self.servo.on,
            sample_age_ms=(slot.now - measurement.time) * 1e3,
            lateness_us=(slot.now - slot.deadline) * 1e6,
            busy_time_us=(now - inputs.marks[0]) * 1e6,
            missed_slots=self.statistics.missed,
            **parts,
        )
