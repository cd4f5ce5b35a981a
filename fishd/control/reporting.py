"""The reports of the loop to the outside: events, logged and published."""

import logging
from collections.abc import Mapping
from typing import Any

from fishd.control.supervisor import Mode
from fishd.core import text
from fishd.core.clock import Clock
from fishd.core.errors import FishdError
from fishd.core.schema import format_values
from fishd.core.signals import Event, EventKind, Level, Publisher, Reason

log = logging.getLogger(__name__)


class Reporter:
    """Logs the events of the loop, and passes them to the publisher with their times."""

    def __init__(self, clock: Clock, publisher: Publisher | None) -> None:
        """publisher: None where events have no reader; they are logged nevertheless"""
        self._clock = clock
        self._publisher = publisher
        self._latest_problem: str | None = None

    def event(self, kind: EventKind, message: str, level: Level = "info", **data: Any) -> None:
        """Publish and log an event; never raises, so that a report cannot cause another problem."""
        message = text.line(message)
        log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", kind, message)
        if self._publisher is None:
            return
        try:
            wall, now = self._clock.wall(), self._clock.monotonic()
            self._publisher.event(Event(wall, level, kind, message, data, now))
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
        if mode is Mode.FAULT:
            assert reason is not None
            message = f"{reason.code}: {reason.message}"
            self.event("fault", message, "error", code=reason.code, mode=mode.value)
            return
        self._latest_problem = None  # log a failure again if it returns after a clear
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


def _format_parameters(parameters: Mapping[str, Any], units: Mapping[str, str]) -> str:
    return format_values(parameters, units, ", ") or "no parameters"
