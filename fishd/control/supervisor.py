"""The modes and what leads from one to another: pure decisions, no I/O.

idle  ──start──▶ running          fault: what went wrong is latched; neutral, then no pulses
  ◀────stop────                   estop: no pulses at once
any   ──fail───▶ fault  ──clear──▶ idle
any   ──estop──▶ estop  ──clear──▶ idle
"""

from collections import deque
from enum import StrEnum

from fishd import text
from fishd.errors import Refused
from fishd.signals import Reason

SENSOR_STREAK = 3
"""Failed reads in a row that are a fault."""
SLOW_STREAK = 3
"""Updates over budget in a row that are a fault."""
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
    """Keeps the mode, the latched reason, and count of the things that may go wrong a few times."""

    def __init__(self) -> None:
        self.mode = Mode.IDLE
        self.reason: Reason | None = None
        self._bad_reads = 0
        self._suspect = 0
        self._slow_updates = 0
        self._ticks = 0
        self._overruns: deque[int] = deque()  # in which of the latest ticks

    def check_startable(self) -> None:
        """Raises `Refused` while a fault or an emergency stop is latched."""
        if self.reason is not None:
            raise Refused(
                self.mode.value,
                f"fishd is in {self.mode}: {self.reason.message}; "
                "mend the cause, then clear it with 'fishctl clear-fault'",
            )

    def start(self) -> None:
        """A controller takes over; raises `Refused` while a fault or estop is latched."""
        self.check_startable()
        self.mode = Mode.RUNNING

    def stop(self) -> None:
        """Go to idle; with a fault or an emergency stop latched the fish has stopped already."""
        if self.reason is None:
            self.mode = Mode.IDLE

    def fail(self, code: str, message: str) -> bool:
        """Latch a fault; False when one is latched already, whose reason is then kept."""
        if self.reason is not None:
            return False
        self.mode = Mode.FAULT
        self.reason = Reason(code=text.quoted(code), message=text.line(message))
        return True

    def estop(self, message: str) -> None:
        """Latch an emergency stop; the reason of an earlier one is kept."""
        if self.mode is not Mode.ESTOP:
            self.mode = Mode.ESTOP
            self.reason = Reason(code="estop", message=text.line(message))

    def clear(self) -> None:
        """Forget the latched reason, if there is one, and go to idle."""
        if self.reason is not None:
            self.mode = Mode.IDLE
            self.reason = None
            self._bad_reads = self._suspect = self._slow_updates = 0
            self._overruns.clear()

    def sensor(self, problem: str | None) -> bool:
        """Count a read, good (None) or not; True when that latches the fault sensor-stale."""
        self._bad_reads = self._bad_reads + 1 if problem else 0
        return (
            problem is not None
            and self._bad_reads >= SENSOR_STREAK
            and self.fail("sensor-stale", f"{problem}, {self._bad_reads} times in a row")
        )

    def suspect(self, suspicion: str) -> bool:
        """Count a window, one to believe (empty) or not; True when that latches sensor-range."""
        self._suspect = self._suspect + 1 if suspicion else 0
        return self._suspect >= SENSOR_STREAK and self.fail(
            "sensor-range", f"{suspicion}, in {self._suspect} windows in a row"
        )

    @property
    def sensor_lost(self) -> bool:
        """Whether the latest SENSOR_STREAK reads gave no force, or none to believe."""
        return max(self._bad_reads, self._suspect) >= SENSOR_STREAK

    def update_time(self, seconds: float, budget: float, controller: str) -> bool:
        """Count an update of the controller; True when that latches the fault controller-slow."""
        self._slow_updates = self._slow_updates + 1 if seconds > budget else 0
        return self._slow_updates >= SLOW_STREAK and self.fail(
            "controller-slow",
            f"controller {controller} took {seconds * 1e3:.1f} ms of its {budget * 1e3:.1f} ms, "
            f"{self._slow_updates} times in a row",
        )

    def overrun(self, overran: bool) -> bool:
        """Count a tick; True when that latches the fault overrun."""
        self._ticks += 1
        while self._overruns and self._overruns[0] <= self._ticks - OVERRUN_WINDOW:
            self._overruns.popleft()
        if overran:
            self._overruns.append(self._ticks)
        count = len(self._overruns)
        return count > OVERRUN_SHARE * OVERRUN_WINDOW and self.fail(
            "overrun", f"{count} of the last {OVERRUN_WINDOW} ticks took too long or came late"
        )
