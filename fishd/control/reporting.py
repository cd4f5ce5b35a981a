"""The output of the loop to the outside: the record of each tick, and events."""

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from msgspec import UNSET

from fishd.control.supervisor import Mode
from fishd.core import text
from fishd.core.clock import Clock
from fishd.core.errors import FishdError
from fishd.core.schema import format_values
from fishd.core.signals import Event, EventKind, Level, Reason, Tick

if TYPE_CHECKING:
    from fishd.control.loop import ControlLoop, Turn

log = logging.getLogger(__name__)


class Publisher(Protocol):
    """The receiver of ticks and events; must not block."""

    def tick(self, tick: Tick) -> None:
        """Publish one tick."""

    def event(self, event: Event) -> None:
        """Publish one event."""


class Reporter:
    """Adds the wall-clock time to ticks and events, and passes them to the publisher."""

    def __init__(self, clock: Clock, publisher: Publisher | None) -> None:
        """publisher: None where ticks and events have no reader; events are logged nevertheless"""
        self.publishes = publisher is not None
        """Whether the records of ticks have a reader."""
        self._clock = clock
        self._publisher = publisher
        self._latest_problem = ""
        self._mode = Mode.IDLE.value

    def event(self, kind: EventKind, message: str, level: Level = "info", **data: Any) -> None:
        """Publish and log an event; never raises, so that a report cannot cause another problem."""
        message = text.line(message)
        log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", kind, message)
        if self._publisher is None:
            return
        try:
            self._publisher.event(Event(self._clock.wall(), level, kind, message, data))
        except Exception:
            log.exception("the event could not be published")

    def controller(
        self,
        kind: EventKind,
        name: str,
        parameters: Mapping[str, Any],
        units: Mapping[str, str],
    ) -> None:
        """Report that a controller is active now, or has new parameters (kind `parameters`).

        units: unit of each parameter, by name
        """
        verb = "continues with" if kind == "parameters" else "takes over with"
        message = f"{name} {verb} {_format_parameters(parameters, units)}"
        self.event(kind, message, controller=name, parameters=parameters)

    def fallback(
        self,
        before: str,
        name: str,
        parameters: Mapping[str, Any],
        units: Mapping[str, str],
        why: Reason,
    ) -> None:
        """Report that a controller gave up and another one is active now."""
        self.event(
            "fallback",
            f"{name} takes over with {_format_parameters(parameters, units)}: {why.message}",
            "warning",
            controller=name,
            parameters=parameters,
            before=before,
            code=why.code,
        )

    def mode(self, before: Mode, mode: Mode, reason: Reason | None) -> None:
        """Report a change of mode and its reason; mode fault gives an event of kind `fault`."""
        self._mode = mode.value
        if mode is Mode.FAULT:
            assert reason is not None
            message = f"{reason.code}: {reason.message}"
            self.event("fault", message, "error", code=reason.code, mode=mode.value)
            return
        self._latest_problem = ""  # log a failure again if it returns after a clear
        message = f"{before} → {mode}" + (f": {reason.message}" if reason else "")
        level: Level = "error" if mode is Mode.ESTOP else "info"
        self.event("mode", message, level, before=before.value, mode=mode.value)

    def problem(self, what: str, error: Exception) -> str:
        """Log that something failed, unless the latest problem was the same; return the line."""
        line = text.line(f"{what}: {text.describe_error(error)}")
        if line != self._latest_problem:
            log.error("%s", line, exc_info=None if isinstance(error, FishdError) else error)
        self._latest_problem = line
        return line

    def tick(self, loop: "ControlLoop", turn: "Turn", now: float) -> None:
        """Publish the record of a tick; all its fields are filled here.

        now: time after the servo was driven [s, monotonic]
        """
        assert self._publisher
        slot, measurement, observation, power = (
            turn.slot,
            turn.measurement,
            turn.observation,
            turn.power,
        )
        thrust, thrust_ci95 = loop.known_thrust
        extremes = measurement.extremes
        swims = loop.supervisor.mode is Mode.RUNNING
        factor = observation.thrust_factor if swims else None
        factor_ci95 = observation.thrust_factor_error if swims else None
        truth = loop.robot.truth() if loop.robot.truth else None
        course = truth.course if truth else None
        corrected = loop.fy_corrected
        self._publisher.tick(
            Tick(
                t=self._clock.wall(),
                seq=loop.seq,
                mode=self._mode,
                controller=loop.active.name,
                fx=measurement.fx,
                fy=measurement.fy,
                fy_rate=-observation.fy_rate if corrected else observation.fy_rate,
                fin_velocity=observation.fin_velocity,
                phi_c=loop.applied,
                servo_on=loop.servo.on,
                thrust=thrust,
                thrust_error=UNSET if thrust_ci95 is None else thrust_ci95,
                frequency=observation.frequency,
                samples=measurement.samples,
                fx_min=extremes.fx_min if extremes else UNSET,
                fx_max=extremes.fx_max if extremes else UNSET,
                fy_min=extremes.fy_min if extremes else UNSET,
                fy_max=extremes.fy_max if extremes else UNSET,
                age_ms=(slot.now - measurement.time) * 1e3,
                lateness_us=(slot.now - slot.deadline) * 1e6,
                busy_us=(now - turn.marks[0]) * 1e6,
                missed=loop.statistics.missed,
                alpha=truth.alpha if truth else UNSET,
                alpha_rate=truth.alpha_rate if truth else UNSET,
                phi=truth.phi if truth else UNSET,
                quantities=loop.active.quantities or UNSET,
                time=observation.time,
                x=course.x if course else UNSET,
                y=course.y if course else UNSET,
                speed=course.speed if course else UNSET,
                heading=course.heading if course else UNSET,
                thrust_factor=UNSET if factor is None else factor,
                thrust_factor_error=UNSET if factor_ci95 is None else factor_ci95,
                power=UNSET if power is None else power,
                leak=UNSET if loop.found_leak is None else loop.found_leak,
                fy_corrected=True if corrected else UNSET,
                suspect=text.line(measurement.suspect) if measurement.suspect else UNSET,
            )
        )


def _format_parameters(parameters: Mapping[str, Any], units: Mapping[str, str]) -> str:
    return format_values(parameters, units, ", ") or "no parameters"
