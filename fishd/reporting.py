"""What the loop tells the world: the record of each tick, events, reasons of overruns."""

import logging
from typing import Any, Protocol

from msgspec import UNSET

from fishd.clock import Clock, Slot
from fishd.signals import Event, Measurement, Observation, Tick, Truth
from fishd.statistics import PHASES
from fishd.supervisor import Mode

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

    def event(self, kind: str, message: str, level: str = "info", **data: Any) -> None:
        """Publish and log an event; never raises, since bad news must not make things worse."""
        log.log(logging.getLevelNamesMapping()[level.upper()], "%s: %s", kind, message)
        try:
            self._publisher.event(Event(self._clock.wall(), level, kind, message, data))
        except Exception:
            log.exception("the event could not be published")

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
        now = slot.now
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
                age_ms=(now - measurement.time) * 1e3,
                lateness_us=(now - slot.deadline) * 1e6,
                busy_us=busy * 1e6,
                missed=missed,
                alpha=truth.alpha if truth else UNSET,
                alpha_rate=truth.alpha_rate if truth else UNSET,
                phi=truth.phi if truth else UNSET,
            )
        )


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
