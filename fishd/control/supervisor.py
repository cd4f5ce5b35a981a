"""The modes and what leads from one to another: pure decisions, no I/O.

idle  ──start──▶ running          fault: what went wrong is latched; neutral, then no pulses
  ◀────stop────                   estop: no pulses at once
any   ──fail───▶ fault  ──clear──▶ idle
any   ──estop──▶ estop  ──clear──▶ idle
"""

from collections import deque
from collections.abc import Callable
from enum import StrEnum

from fishd.control.faults import FAULTS, UNLISTED
from fishd.core import text
from fishd.core.errors import Refused
from fishd.core.signals import Reason

OVERRUN_WINDOW = 100
"""Number of ticks over which overruns are counted."""
OVERRUN_SHARE = 0.2
"""Largest fraction of overruns among the latest OVERRUN_WINDOW ticks; more is a fault."""


class Mode(StrEnum):
    """Mode of fishd."""

    IDLE = "idle"
    RUNNING = "running"
    FAULT = "fault"
    ESTOP = "estop"


class Supervisor:
    """The mode and the latched reason; counts failures that are a fault only when repeated."""

    def __init__(self, changed: Callable[[Mode], None] = lambda before: None) -> None:
        """changed: called after each change of mode, with the previous mode"""
        self.mode = Mode.IDLE
        self.reason: Reason | None = None
        self._changed = changed
        self.failures: dict[str, int] = {}
        """Number of failures in a row of each check that failed last, by fault code."""
        self._overruns: deque[int] = deque()
        """Sequence numbers of the latest ticks that overran."""

    def check_startable(self) -> None:
        """Raise `Refused` while a fault or an emergency stop is latched."""
        if self.reason is not None:
            raise Refused(
                self.mode.value,
                f"fishd is in {self.mode}: {self.reason.message}; "
                "mend the cause, then clear it with 'fishctl clear-fault'",
            )

    def start(self) -> None:
        """Enter mode running for a new controller; raise `Refused` while a reason is latched.

        Slow updates of the previous controller do not count against the new one.
        """
        self.check_startable()
        self.failures.pop("controller-slow", None)
        self._enter(Mode.RUNNING)

    def stop(self) -> None:
        """Go to idle, unless a fault or an emergency stop is latched: then the fish has stopped."""
        if self.reason is None:
            self._enter(Mode.IDLE)

    def clear(self) -> None:
        """Clear the latched reason, if there is one, and go to idle."""
        if self.reason is not None:
            self.failures.clear()
            self._overruns.clear()
            self._enter(Mode.IDLE)

    def estop(self, message: str) -> None:
        """Latch an emergency stop, which keeps the reason of an earlier emergency stop."""
        self.fail("estop", message)

    def fail(self, code: str, message: str) -> None:
        """Latch a fault. The first reason is kept, except that an emergency stop replaces a fault.

        code: a key of FAULTS, or a code of a controller from another package
        """
        fault = FAULTS.get(code, UNLISTED)
        mode = Mode.ESTOP if fault.releases else Mode.FAULT
        if self.reason is None or (mode is Mode.ESTOP and self.mode is Mode.FAULT):
            self._enter(mode, Reason(text.quoted(code), text.line(message), fault.remedy))

    def check(self, code: str, problem: str | None) -> None:
        """Count the result of a check; `in_a_row` failures in a row latch the fault.

        A passed check has an effect only while there are `failures`.

        problem: what failed; None if the check passed
        """
        limit = FAULTS[code].in_a_row
        if not problem:
            self.failures.pop(code, None)
            return
        self.failures[code] = count = self.failures.get(code, 0) + 1
        if count >= limit:
            self.fail(code, f"{problem}, {count} times in a row" if limit > 1 else problem)

    @property
    def sensor_lost(self) -> bool:
        """Whether the latest reads gave no force, or only suspect ones."""
        return any(
            self.failures.get(code, 0) >= FAULTS[code].in_a_row
            for code in ("sensor-stale", "sensor-range")
        )

    def note_overrun(self, seq: int) -> None:
        """Note that a tick overran; too many among the latest ticks latch the fault."""
        self._overruns.append(seq)
        while self._overruns[0] <= seq - OVERRUN_WINDOW:
            self._overruns.popleft()
        count = len(self._overruns)
        if count > OVERRUN_SHARE * OVERRUN_WINDOW:
            message = f"{count} of the last {OVERRUN_WINDOW} ticks took too long or came late"
            self.fail("overrun", message)

    def _enter(self, mode: Mode, reason: Reason | None = None) -> None:
        before, self.mode, self.reason = self.mode, mode, reason
        if mode is not before:
            self._changed(before)
