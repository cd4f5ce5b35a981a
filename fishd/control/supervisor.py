"""The modes and what leads from one to another: pure decisions, no I/O.

idle  ──start──▶ running          fault: what went wrong is latched; neutral, then no pulses
  ◀────stop────                   estop: no pulses at once
any   ──fail───▶ fault  ──clear──▶ idle
any   ──estop──▶ estop  ──clear──▶ idle
"""

from collections import deque
from collections.abc import Callable
from enum import StrEnum

from fishd.control.faults import FAULTS, UNLISTED, Effect
from fishd.core import text
from fishd.core.errors import Refused
from fishd.core.signals import Reason

OVERRUN_WINDOW = 100
OVERRUN_SHARE = 0.2
"""More than this share of overruns among the latest OVERRUN_WINDOW ticks is a fault."""


class Mode(StrEnum):
    """What fishd is doing."""

    IDLE = "idle"
    RUNNING = "running"
    FAULT = "fault"
    ESTOP = "estop"


class Supervisor:
    """Keeps the mode and the latched reason, and counts what may go wrong a few times."""

    def __init__(self, changed: Callable[[Mode], None] = lambda before: None) -> None:
        """changed: called after each change of mode, with the mode before it"""
        self.mode = Mode.IDLE
        self.reason: Reason | None = None
        self._changed = changed
        self.failures: dict[str, int] = {}
        """Number of failures in a row of each check that failed last, by the code of its fault."""
        self._overruns: deque[int] = deque()
        """Numbers of the latest ticks that overran."""

    def check_startable(self) -> None:
        """Raises `Refused` while a fault or an emergency stop is latched."""
        if self.reason is not None:
            raise Refused(
                self.mode.value,
                f"fishd is in {self.mode}: {self.reason.message}; "
                "mend the cause, then clear it with 'fishctl clear-fault'",
            )

    def start(self) -> None:
        """A controller takes over; raises `Refused` while a fault or estop is latched.

        It is not to blame for how slow the one before it was.
        """
        self.check_startable()
        self.failures.pop("controller-slow", None)
        self._enter(Mode.RUNNING)

    def stop(self) -> None:
        """Go to idle; with a fault or an emergency stop latched the fish has stopped already."""
        if self.reason is None:
            self._enter(Mode.IDLE)

    def clear(self) -> None:
        """Forget the latched reason, if there is one, and go to idle."""
        if self.reason is not None:
            self.failures.clear()
            self._overruns.clear()
            self._enter(Mode.IDLE)

    def estop(self, message: str) -> None:
        """Latch an emergency stop; the reason of an earlier one is kept."""
        self.fail("estop", message)

    def fail(self, code: str, message: str) -> None:
        """Latch a fault. The first reason is kept, but an emergency stop replaces that of a fault.

        code: that of a row of FAULTS, or of a controller from another package
        """
        row = FAULTS.get(code, UNLISTED)
        mode = Mode.ESTOP if row.effect is Effect.RELEASE else Mode.FAULT
        if self.reason is None or (mode is Mode.ESTOP and self.mode is Mode.FAULT):
            self._enter(mode, Reason(text.quoted(code), text.line(message), row.remedy))

    def check(self, code: str, problem: str | None) -> None:
        """Count a check, failed or passed (None or empty); `in_a_row` failures latch the fault.

        One that passed makes a difference only while there are `failures`.
        """
        enough = FAULTS[code].in_a_row
        if not problem:
            self.failures.pop(code, None)
            return
        self.failures[code] = count = self.failures.get(code, 0) + 1
        if count >= enough:
            self.fail(code, f"{problem}, {count} times in a row" if enough > 1 else problem)

    @property
    def sensor_lost(self) -> bool:
        """Whether the latest reads gave no force, or none to believe."""
        return any(
            self.failures.get(code, 0) >= FAULTS[code].in_a_row
            for code in ("sensor-stale", "sensor-range")
        )

    def overran(self, seq: int) -> None:
        """Note that the tick of this number overran; too many among the latest latch the fault."""
        self._overruns.append(seq)
        while self._overruns[0] <= seq - OVERRUN_WINDOW:
            self._overruns.popleft()
        count = len(self._overruns)
        if count > OVERRUN_SHARE * OVERRUN_WINDOW:
            late = f"{count} of the last {OVERRUN_WINDOW} ticks took too long or came late"
            self.fail("overrun", late)

    def _enter(self, mode: Mode, reason: Reason | None = None) -> None:
        before, self.mode, self.reason = self.mode, mode, reason
        if mode is not before:
            self._changed(before)
