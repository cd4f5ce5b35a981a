"""What the loop tells the world: the record of each tick, events, reasons of overruns."""

import logging
from collections.abc import Mapping
from typing import Any, Protocol

from msgspec import UNSET

from fishd import text
from fishd.clock import Clock, Slot
from fishd.errors import FishdError
from fishd.signals import Event, Measurement, Observation, Reason, Tick, Truth
from fishd.statistics import PHASES
from fishd.supervisor import Mode, Supervisor

log = logging.getLogger(__name__)


class Publisher(Protocol):
    """Where ticks and events go; must not block."""

    def tick(self, tick: Tick) -> None:
        """Publish one tick."""

    def event(self, event: Event) -> None:
        """Publish one event."""


class Reporter:
    """Stamps what the loop says with the time and hands it to the publisher."""

    def __init__(self, clock: Clock, publisher: Publisher) -> None:
        self._clock = clock
        self._publisher = publisher
        self._latest_problem = ""

    def event(self, kind: str, message: str, level: str = "info", **data: Any) -> None:
        """Publish and log an event; never raises, since bad news must not make things worse."""
        message = text.line(message)
        log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", kind, message)
        try:
            self._publisher.event(Event(self._clock.wall(), level, kind, message, data))
        except Exception:
            log.exception("the event could not be published")

    def controller(self, name: str, parameters: Mapping[str, Any], kind: str, does: str) -> None:
        """Tell who is in command with which parameters; does: such as `takes over with`."""
        message = f"{name} {does} {_spelled(parameters)}"
        self.event(kind, message, controller=name, parameters=parameters)

    def fallback(self, before: str, name: str, parameters: Mapping[str, Any], why: Reason) -> None:
        """Tell that a controller has lost command to another one."""
        self.event(
            "fallback",
            f"{name} takes over with {_spelled(parameters)}: {why.message}",
            "warning",
            controller=name,
            parameters=parameters,
            before=before,
            code=why.code,
        )

    def mode(self, before: Mode, supervisor: Supervisor, level: str = "info") -> None:
        """Tell which mode follows on `before`, if it is another."""
        mode, reason = supervisor.mode, supervisor.reason
        if mode is before:
            return
        self._latest_problem = ""  # what fails again after a clear is news
        message = f"{before} → {mode}" + (f": {reason.message}" if reason else "")
        self.event("mode", message, level, before=before.value, mode=mode.value)

    def problem(self, what: str, error: Exception) -> str:
        """Log that something failed, with its error, once; gives the two in one line."""
        line = text.line(f"{what}: {text.named(error)}")
        if line != self._latest_problem:
            log.error("%s", line, exc_info=None if isinstance(error, FishdError) else error)
        self._latest_problem = line
        return line

    def fault(self, supervisor: Supervisor) -> None:
        """Tell of the fault that was just latched."""
        reason = supervisor.reason
        assert reason is not None
        message = f"{reason.code}: {reason.message}"
        self.event("fault", message, "error", code=reason.code, mode=supervisor.mode.value)

    def tick(
        self,
        slot: Slot,
        measurement: Measurement,
        observation: Observation,
        truth: Truth | None,
        *,
        seq: int,
        mode: Mode,
        controller: str,
        angle: float,
        servo_on: bool,
        busy: float,
        missed: int,
    ) -> None:
        """Seal and publish the record of a tick.

        angle: the instruction angle that was sent [rad]
        busy: time that the tick has taken so far [s]
        missed: slots skipped since start
        """
        now, extremes = slot.now, measurement.extremes
        self._publisher.tick(
            Tick(
                t=self._clock.wall(),
                seq=seq,
                mode=mode.value,
                controller=controller,
                fx=observation.fx,
                fy=observation.fy,
                fy_rate=observation.fy_rate,
                fin_velocity=observation.fin_velocity,
                phi_c=angle,
                servo_on=servo_on,
                thrust=observation.thrust,
                frequency=observation.frequency,
                samples=measurement.samples,
                fx_min=extremes.fx_min if extremes else UNSET,
                fx_max=extremes.fx_max if extremes else UNSET,
                fy_min=extremes.fy_min if extremes else UNSET,
                fy_max=extremes.fy_max if extremes else UNSET,
                age_ms=(now - measurement.time) * 1e3,
                lateness_us=(now - slot.deadline) * 1e6,
                busy_us=busy * 1e6,
                missed=missed,
                alpha=truth.alpha if truth else UNSET,
                alpha_rate=truth.alpha_rate if truth else UNSET,
                phi=truth.phi if truth else UNSET,
            )
        )


def _spelled(parameters: Mapping[str, Any]) -> str:
    texts = (f"{k}={'default' if v is None else v}" for k, v in parameters.items())
    return ", ".join(texts) or "no parameters"


def why_overrun(seq: int, marks: tuple[float, ...], period: float) -> str | None:
    """One line that blames the right phase of a tick that took longer than a period [s], or None.

    marks: times at the start of the tick and after each of PHASES [s]
    """
    busy = marks[-1] - marks[0]
    if busy <= period:
        return None
    longest, phase = max(
        (after - before, name)
        for before, after, name in zip(marks[:-1], marks[1:], PHASES, strict=True)
    )
    return (
        f"tick {seq} took {busy * 1e3:.1f} ms of its {period * 1e3:g} ms, "
        f"{longest * 1e3:.1f} ms of it in {phase}"
    )


def why_silent(silence: float) -> str:
    """One line on a servo that was left alone for so long [s] that it has come to rest."""
    return (
        f"fishd stood still for {silence * 1e3:.0f} ms, and the servo has gone to neutral and "
        "ends its pulses by itself: the machine is overloaded or was suspended"
    )


def why_skipped(seq: int, missed: int) -> str | None:
    """One line on slots that were skipped although no tick was to blame, or None."""
    if not missed:
        return None
    return (
        f"{missed} slots were skipped before tick {seq}: fishd was woken late, "
        "the machine is overloaded or was suspended"
    )
