"""The perception of the loop: forces, the observation of a tick, and the thrust that follows.

It reads the force sensor and never raises: the supervisor decides about failures.
"""

import math
from typing import Any

from msgspec.structs import asdict, replace

from fishd.control.active_controller import ActiveController
from fishd.control.estimators.base import Estimator
from fishd.control.estimators.lateral_sign import LateralSign
from fishd.control.estimators.live_thrust import LiveThrust
from fishd.control.reporting import Reporter
from fishd.control.supervisor import Mode, Supervisor
from fishd.controllers.base import Controller, Limits
from fishd.core import text
from fishd.core.clock import Slot
from fishd.core.errors import FishLost, Refused, SensorError
from fishd.core.signals import Measurement, Observation
from fishd.hardware.base import ForceSensor

MAX_SAMPLE_AGE_PERIODS = 2.0
"""Largest age of the newest sample, in periods; a read with an older one counts as failed."""


class Perception:
    """The observation of each tick, the known thrust, and the sign of F_y."""

    def __init__(
        self,
        estimator: Estimator,
        thrust: LiveThrust,
        lateral_sign: LateralSign,
        sensor: ForceSensor,
        active: ActiveController,
        supervisor: Supervisor,
        reporter: Reporter,
        limits: Limits,
        started: float,
    ) -> None:
        """started: time before which nothing is measured [s, monotonic]"""
        self.estimator = estimator
        self.thrust = thrust
        self.lateral_sign = lateral_sign
        self.observation: Observation | None = None
        """Observation of the latest tick; None before the first one."""
        self.found_leak = estimator.found_leak
        """Leak time of the estimator at the latest tick [s]; None unless the estimator finds it."""
        self._sensor = sensor
        self._active = active
        self._supervisor = supervisor
        self._reporter = reporter
        self._max_age = MAX_SAMPLE_AGE_PERIODS * limits.tick
        self._tethered = limits.tethered
        self._trusted = Measurement(started, 0.0, 0.0, 0)
        """Latest measurement that was not suspect."""

    @property
    def known_thrust(self) -> tuple[float, float | None]:
        """Thrust and the half-width of its 95 % confidence interval [N].

        While the zero of the force is not known, it is the measured thrust, without a half-width.
        """
        if self.thrust.thrust is not None:
            return self.thrust.thrust, self.thrust.ci95
        return (self.observation.thrust if self.observation else 0.0), None

    def read(self, slot: Slot) -> Measurement:
        """Return the forces since the previous tick, or the last trusted ones if that fails."""
        supervisor, problem = self._supervisor, None
        try:
            measurement = self._sensor.read(slot.deadline)
            if not math.isfinite(measurement.fx + measurement.fy):
                raise SensorError(f"it gave ({measurement.fx}, {measurement.fy}) N")
        except Exception as error:
            if isinstance(error, FishLost):
                self._fail("fish-lost", "the fish cannot be read any more", error)
            problem = f"the force sensor cannot be read: {text.describe_error(error)}"
            measurement = self._last_trusted_measurement()
        else:
            if measurement.suspect or supervisor.failures:
                supervisor.check("sensor-range", measurement.suspect)
            if not measurement.samples:  # it repeats forces that may have been suspect
                measurement = replace(measurement, fx=self._trusted.fx, fy=self._trusted.fy)
        if not measurement.suspect:
            self._trusted = measurement
        age = slot.now - measurement.time
        if problem is None and age > self._max_age:
            problem = f"the newest force sample is {age * 1e3:.0f} ms old"
        if problem or supervisor.failures:
            supervisor.check("sensor-stale", problem)
        return measurement

    def observe(
        self,
        measurement: Measurement,
        slot: Slot,
        dt: float,
        instruction_angle: float,
        readings: dict[str, float] | None = None,
    ) -> Observation:
        """Return the observation of a tick.

        dt: time since the previous tick [s]
        instruction_angle: the one that was sent in the previous tick [rad]
        readings: those of the other sensors, by name
        """
        suspect = bool(measurement.suspect)
        trusted = self._last_trusted_measurement() if suspect else measurement
        observation = self._estimate(trusted, slot.deadline, dt, instruction_angle)
        # Without a trusted force there is nothing to learn about thrust and sign.
        if not (self._supervisor.failures and self._supervisor.sensor_lost):
            observation = self._follow_thrust(observation, suspect)
            if self._tethered:
                self._watch_sign(observation, measurement.fy, suspect)
        if readings:
            observation = replace(observation, readings=readings)
        self.observation = observation
        return observation

    def rest(self) -> None:
        """Note that no controller moves the tail any more, so it does not beat."""
        self.estimator.rest()

    def forget_force(self, *, scale: bool) -> None:
        """Discard what depends on the zero of the force sensor, which was changed.

        scale: whether the rest of its calibration was changed, too
        """
        self.estimator.forget_zero()
        if scale:
            self.thrust.forget()
            self.lateral_sign.forget()
        else:
            self.thrust.forget_zero()
            self.lateral_sign.rest()

    def check_usable(self, controller: Controller[Any]) -> None:
        """Raise `Refused` if F_y is reversed and the controller must not use it then."""
        complaint = self.lateral_sign.complaint
        if complaint and self._is_refused(controller):
            raise Refused("fy-reversed", complaint)

    def telemetry(self, measurement: Measurement, observation: Observation) -> dict[str, Any]:
        """Return the fields of `Tick` about forces and what follows from them.

        A field that is unknown is absent.
        """
        thrust, thrust_ci95 = self.known_thrust
        corrected = self.estimator.fy_corrected
        fields: dict[str, Any] = {
            "time": observation.time,
            "fx": measurement.fx,
            "fy": measurement.fy,
            # Telemetry shows F_y as measured; the observation may have the opposite sign.
            "fy_rate": -observation.fy_rate if corrected else observation.fy_rate,
            "fin_velocity": observation.fin_velocity,
            "thrust": thrust,
            "frequency": observation.frequency,
            "samples": measurement.samples,
        }
        if corrected:
            fields["fy_corrected"] = True
        if thrust_ci95 is not None:
            fields["thrust_ci95"] = thrust_ci95
        if observation.thrust_factor is not None and self._supervisor.mode is Mode.RUNNING:
            fields["thrust_factor"] = observation.thrust_factor
            fields["thrust_factor_ci95"] = observation.thrust_factor_ci95
        if self.found_leak is not None:
            fields["leak"] = self.found_leak
        if measurement.extremes:
            fields |= asdict(measurement.extremes)
        if measurement.suspect:
            fields["suspect"] = text.line(measurement.suspect)
        if measurement.mean_time is not None:
            fields["force_age_ms"] = (observation.time - measurement.mean_time) * 1e3
            fields["force_span_ms"] = measurement.span * 1e3
        return fields

    def _fail(self, code: str, what: str, error: Exception) -> None:
        self._supervisor.fail(code, self._reporter.problem(what, error))

    def _last_trusted_measurement(self) -> Measurement:
        """Return the last trusted measurement, marked as holding no new samples."""
        return replace(self._trusted, samples=0, extremes=None)

    def _estimate(
        self, measurement: Measurement, now: float, dt: float, instruction_angle: float
    ) -> Observation:
        try:
            if self.estimator.fy_corrected is not self.lateral_sign.corrected:
                self.estimator.reverse_fy()
            known = self.thrust.factor
            seen = self.estimator.update(measurement, instruction_angle, now, dt, known)
            if not math.isfinite(seen.fy_rate + seen.fin_velocity + seen.thrust):
                raise ArithmeticError(f"it gave a fin velocity of {seen.fin_velocity}")
            return seen
        except Exception as error:
            self._fail("estimate-error", "the estimator failed", error)
            fx, fy, angle = measurement.fx, measurement.fy, instruction_angle
            return Observation(now, dt, fx, fy, 0.0, 0.0, angle, angle, 0.0, 0.0)

    def _follow_thrust(self, observation: Observation, suspect: bool) -> Observation:
        """Return the observation with the factor of the thrust, which is reset if its update fails.

        suspect: whether the force of this tick is suspect
        """
        try:
            if self.estimator.found_leak != self.found_leak:
                self.found_leak = self.estimator.found_leak
                self.thrust.forget_factor()  # it belongs to fin velocities of another scale
            running = self._supervisor.mode is Mode.RUNNING
            self.thrust.update(observation, running, self._active.wave)
            if suspect:
                self.thrust.interrupt()
            known = self.thrust.factor
        except ArithmeticError as error:
            self._reporter.problem("the estimate of the thrust failed and was reset", error)
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
            has_changed = self.lateral_sign.update(observation, fy)
            if has_changed and (complaint := self.lateral_sign.complaint):
                self._reporter.event("calibration", complaint, "warning")
                if self._is_refused(self._active.controller):
                    self._supervisor.fail("fy-reversed", complaint)
        except ArithmeticError as error:
            self._reporter.problem("the check of the sign of F_y failed and was reset", error)
            self.lateral_sign.forget()

    def _is_refused(self, controller: Controller[Any]) -> bool:
        # `is not False`: a value of any type in third-party code raises nothing here.
        return self.lateral_sign.refuses and type(controller).uses_lateral_force is not False
