"""The control loop: one synchronous function, `ControlLoop.tick`, for daemon and simulation alike.

The daemon calls it from asyncio every period, simulation and tests from a plain `for` on a virtual
clock. It never raises: whatever goes wrong, the supervisor decides and the servo goes neutral.
All other methods are called between two ticks, by the thread that calls `tick`.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from msgspec import UNSET, Struct
from msgspec.structs import replace

from fishd.control.active_controller import ActiveController, Successor, fault_and_successor
from fishd.control.estimators.base import Estimator
from fishd.control.estimators.lateral_sign import LateralSign
from fishd.control.estimators.live_thrust import LiveThrust
from fishd.control.guard import Guard
from fishd.control.lease import Lease
from fishd.control.readings import Readings
from fishd.control.reporting import Reporter
from fishd.control.servo import ServoOutput
from fishd.control.statistics import Statistics
from fishd.control.supervisor import Mode, Supervisor
from fishd.controllers.base import Controller, Limits
from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import Clock, Slot
from fishd.core.errors import ControllerFault, FishLost, Refused, SensorError
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
MAX_SAMPLE_AGE_PERIODS = 2.0
"""Largest age of the newest sample, in periods; a read with an older one counts as failed."""


class Turn(Struct, frozen=True, gc=False):
    """The result of the first half of a tick."""

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
        guard: Guard,
        settings: LoopSettings,
        limits: Limits,
        clock: Clock,
        publisher: Publisher | None,
        notify: Callable[[float], None] | None = None,
        lateral_sign: LateralSign | None = None,
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
        self.readings = Readings(robot.sensors, self.reporter, settings.tick, clock.monotonic())
        self.seq = 0
        """Sequence number of the latest tick."""
        self.applied = 0.0
        """Instruction angle that was sent last, after the guard [rad]."""
        self.neutral_for = 0.0
        """Time since the instruction angle became zero [s]."""
        self.thrust = thrust
        self.lateral_sign = lateral_sign or LateralSign()
        self.fy_corrected = False
        """Whether the latest observation has F_y with the opposite sign of the measured F_y."""
        self.observation: Observation | None = None
        """Observation of the latest tick; None before the first one."""
        self._estimator = estimator
        self.found_leak = estimator.found_leak
        """Leak time of the estimator at the latest tick [s]; None unless the estimator finds it."""
        self._now, self._wall = clock.monotonic, clock.wall
        self._publisher = publisher
        self._mode = self.supervisor.mode.value
        self._notify = notify
        self._budget = UPDATE_BUDGET * settings.tick
        self._trusted = Measurement(clock.monotonic(), 0.0, 0.0, 0)
        """Latest measurement that was not suspect."""
        self._index = -1
        self._pending: tuple[int, str, Controller[Any], ServoCalibration | None] | None = None

    @property
    def known_thrust(self) -> tuple[float, float | None]:
        """Thrust and the half-width of its 95 % confidence interval [N].

        While the zero of the force is not known, it is the measured thrust, without a half-width.
        """
        if self.thrust.thrust is not None:
            return self.thrust.thrust, self.thrust.ci95
        return (self.observation.thrust if self.observation else 0.0), None

    @property
    def has_settled(self) -> bool:
        """Whether the servo has been at neutral for `SETTLE_TIME_S`, so that its pulses may end."""
        return self.neutral_for >= SETTLE_TIME_S - 1e-9

    def tick(self, slot: Slot) -> None:
        """Run one tick of the loop."""
        self.act(self.observe(slot))

    def observe(self, slot: Slot) -> Turn:
        """Run the first half of a tick: read and estimate. `act` must follow, with the result.

        Between the two, `observation` is the one that the controller will receive.
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
        measurement = self._read(slot)
        if self.readings.sensors:
            self._read_sensors(slot)
        read = self._now()
        suspect = bool(measurement.suspect)
        observation = self._estimate(
            self._last_trusted_measurement() if suspect else measurement, slot, dt
        )
        if not (self.supervisor.failures and self.supervisor.sensor_lost):
            observation = self._follow_thrust(observation, suspect)
            if self.limits.tethered:
                self._watch_sign(observation, measurement.fy, suspect)
        if self.readings.latest:
            observation = replace(observation, readings=self.readings.latest)
        self.observation = observation
        return Turn(slot, measurement, observation, (started, read, self._now()))

    def act(self, turn: Turn) -> None:
        """Run the second half of a tick: let the controller choose, drive the servo, publish."""
        slot, observation = turn.slot, turn.observation
        started, read, estimated = turn.marks
        before, self.applied = self.applied, self._update(observation, estimated)
        moved = before or self.applied
        self.neutral_for = 0.0 if moved else self.neutral_for + observation.dt
        updated = self._now()
        self._write(neutral=not moved and self.has_settled)
        written = self._now()
        if self._publisher is not None:
            self._publish(self._publisher, turn, written)
        marks = (started, read, estimated, updated, written, self._now())
        late = self.statistics.add(self.seq, slot.now - slot.deadline, slot.missed, marks)
        if late:
            self.reporter.event("overrun", late, "warning", seq=self.seq, missed_slots=slot.missed)
            self.supervisor.note_overrun(self.seq)
        if self._notify:
            self._notify(started)

    def warm_up(self) -> None:
        """Warm the active controller and the robot up for the imminent tick."""
        self.robot.prepare()
        try:
            self.active.warm_up()
        except Exception as error:
            self._fail("controller-error", f"controller {self.active.name} failed", error)

    def set_controller(self, name: str, controller: Controller[Any]) -> None:
        """Make a controller the active one, from the next tick on.

        Raises `Refused` while a fault or an emergency stop is latched.
        """
        self.supervisor.check_startable()
        if self._is_refused(controller):
            raise Refused("fy-reversed", self.lateral_sign.complaint)
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

    def forget_force(self, *, scale: bool) -> None:
        """Discard what depends on the zero of the force sensor, which was changed.

        scale: whether the rest of its calibration was changed, too
        """
        self._estimator.forget_zero()
        if scale:
            self.thrust.forget()
            self.lateral_sign.forget()
        else:
            self.thrust.forget_zero()
            self.lateral_sign.rest()

    @property
    def pending(self) -> str:
        """Name of the controller that is to start after a time at rest; empty if there is none."""
        return self._pending[1] if self._pending else ""

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
            self._estimator.rest()
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

    def _read(self, slot: Slot) -> Measurement:
        problem = None
        try:
            measurement = self.robot.sensor.read(slot.deadline)
            if not math.isfinite(measurement.fx + measurement.fy):
                raise SensorError(f"it gave ({measurement.fx}, {measurement.fy}) N")
        except Exception as error:
            if isinstance(error, FishLost):
                self._fail("fish-lost", "the fish cannot be read any more", error)
            problem = f"the force sensor cannot be read: {text.describe_error(error)}"
            measurement = self._last_trusted_measurement()
        else:
            if measurement.suspect or self.supervisor.failures:
                self.supervisor.check("sensor-range", measurement.suspect)
            if not measurement.samples:  # it repeats forces that may have been suspect
                measurement = replace(measurement, fx=self._trusted.fx, fy=self._trusted.fy)
        if not measurement.suspect:
            self._trusted = measurement
        age = slot.now - measurement.time
        if problem is None and age > MAX_SAMPLE_AGE_PERIODS * self.settings.tick:
            problem = f"the newest force sample is {age * 1e3:.0f} ms old"
        if problem or self.supervisor.failures:
            self.supervisor.check("sensor-stale", problem)
        return measurement

    def _read_sensors(self, slot: Slot) -> None:
        self.readings.read(slot.deadline)
        lost = self.readings.lost
        if lost or self.supervisor.failures:
            self.supervisor.check("sensor-lost", lost)

    def _last_trusted_measurement(self) -> Measurement:
        """Return the last trusted measurement, marked as holding no new samples."""
        return replace(self._trusted, samples=0, extremes=None)

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
        """Return the observation with the factor of the thrust, which is reset if its update fails.

        suspect: whether the force of this tick is suspect
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
            self.reporter.problem("the estimate of the thrust failed and was reset", error)
            self.thrust.forget()
            known = None
        factor, ci95 = known or (None, None)
        if factor == observation.thrust_factor and ci95 == observation.thrust_factor_ci95:
            return observation
        return replace(observation, thrust_factor=factor, thrust_factor_ci95=ci95)

    def _watch_sign(self, observation: Observation, fy: float, suspect: bool) -> None:
        """Check the sign of F_y when the tail starts to move, and report a reversed one.

        fy: F_y as measured [N]
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
            self.reporter.problem("the check of the sign of F_y failed and was reset", error)
            self.lateral_sign.forget()

    def _is_refused(self, controller: Controller[Any]) -> bool:
        # `is not False`: a value of any type in third-party code raises nothing here.
        return self.lateral_sign.refuses and type(controller).uses_lateral_force is not False

    def _update(
        self, observation: Observation, began: float, *, may_hand_over: bool = True
    ) -> float:
        """Return the angle to apply: that of the controller, guarded, or a step to neutral [rad].

        began: start of the time that the controller may take [s, monotonic]
        may_hand_over: whether a controller that gives up may name a successor: once in a tick
        """
        if self.supervisor.mode is Mode.ESTOP:
            return self.applied
        if self.supervisor.mode is not Mode.RUNNING:
            return self.guard.fade(self.applied)
        name = self.active.name
        try:
            command = call_foreign(self.active.update, observation)
            applied = self.guard.apply(command, self.applied)
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
            return applied
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
        """Send the applied angle, or release the servo, as the mode demands."""
        if self.servo.counts_down and (problem := self.servo.why_at_rest()):
            self.applied = 0.0  # the servo is there; another start would make it jump
            neutral = True
            self.supervisor.fail("overrun", problem)
        latched, lost = self.supervisor.reason, self.servo.lost
        try:
            self.servo.command(self.supervisor.mode, self.applied, neutral)
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

    def _publish(self, publisher: Publisher, turn: Turn, now: float) -> None:
        try:
            publisher.tick(self._record(turn, now))
        except Exception as error:
            self._fail("publish-error", "telemetry cannot be published", error)

    def _record(self, turn: Turn, now: float) -> Tick:
        """Return the record of a tick; all its fields are filled here.

        now: time after the servo was driven [s, monotonic]
        """
        slot, measurement, observation = turn.slot, turn.measurement, turn.observation
        thrust, thrust_ci95 = self.known_thrust
        extremes = measurement.extremes
        swims = self.supervisor.mode is Mode.RUNNING
        factor = observation.thrust_factor if swims else None
        factor_ci95 = observation.thrust_factor_ci95 if swims else None
        truth = self.robot.truth() if self.robot.truth else None
        course = truth.course if truth else None
        corrected, mean_time = self.fy_corrected, measurement.mean_time
        return Tick(
            t=self._wall(),
            seq=self.seq,
            mode=self._mode,
            controller=self.active.name,
            fx=measurement.fx,
            fy=measurement.fy,
            fy_rate=-observation.fy_rate if corrected else observation.fy_rate,
            fin_velocity=observation.fin_velocity,
            phi_c=self.applied,
            servo_on=self.servo.on,
            thrust=thrust,
            thrust_ci95=UNSET if thrust_ci95 is None else thrust_ci95,
            frequency=observation.frequency,
            samples=measurement.samples,
            fx_min=extremes.fx_min if extremes else UNSET,
            fx_max=extremes.fx_max if extremes else UNSET,
            fy_min=extremes.fy_min if extremes else UNSET,
            fy_max=extremes.fy_max if extremes else UNSET,
            sample_age_ms=(slot.now - measurement.time) * 1e3,
            lateness_us=(slot.now - slot.deadline) * 1e6,
            busy_time_us=(now - turn.marks[0]) * 1e6,
            missed_slots=self.statistics.missed,
            alpha=truth.alpha if truth else UNSET,
            alpha_rate=truth.alpha_rate if truth else UNSET,
            phi=truth.phi if truth else UNSET,
            quantities=self.active.quantities or UNSET,
            time=observation.time,
            x=course.x if course else UNSET,
            y=course.y if course else UNSET,
            speed=course.speed if course else UNSET,
            heading=course.heading if course else UNSET,
            thrust_factor=UNSET if factor is None else factor,
            thrust_factor_ci95=UNSET if factor_ci95 is None else factor_ci95,
            readings=observation.readings or UNSET,
            leak=UNSET if self.found_leak is None else self.found_leak,
            fy_corrected=True if corrected else UNSET,
            suspect=text.line(measurement.suspect) if measurement.suspect else UNSET,
            force_age_ms=UNSET if mean_time is None else (slot.deadline - mean_time) * 1e3,
            force_span_ms=UNSET if mean_time is None else measurement.span * 1e3,
        )
