"""The servo's electrical power, where there is a power meter. A fish swims on without it."""

import math
from collections import deque

from fishd.control.reporting import Reporter
from fishd.core import text
from fishd.hardware.base import Robot

SPAN = 2.0
"""What is shown is the mean of so long [s]: some beats."""
FEW = 3
"""So many reads in a row must fail before anybody is told."""


class ServoPower:
    """Reads the power meter in each tick, and remembers a little."""

    def __init__(self, robot: Robot, reporter: Reporter, tick: float) -> None:
        """tick: period of the loop [s]"""
        self.trouble = ""
        """Why it cannot be read, one line; empty while it can, and without a power meter."""
        self.metered = robot.power is not None
        """Whether there is a power meter."""
        self._read = robot.power
        self._reporter = reporter
        self._latest: deque[float] = deque(maxlen=max(1, round(SPAN / tick)))
        self._failed = 0

    @property
    def mean(self) -> float | None:
        """Of the last seconds [W]; None where it is not known."""
        return sum(self._latest) / len(self._latest) if self._latest else None

    def read(self, now: float) -> float | None:
        """Mean power since the previous tick [W]; None where it is not known. Never raises.

        now: start of the tick [s, monotonic]
        """
        if self._read is None:
            return None
        try:
            power = self._read(now)
            if not math.isfinite(power):
                raise ValueError(f"it gave {power} W")
        except Exception as error:
            self._fail(f"the power meter cannot be read: {text.named(error)}")
            return None
        self._failed = 0
        if self.trouble:
            self.trouble = ""
            self._reporter.event("power", "the power meter can be read again")
        self._latest.append(power)
        return power

    def _fail(self, problem: str) -> None:
        self._latest.clear()
        self._failed += 1
        if self._failed >= FEW:
            if not self.trouble:
                self._reporter.event("power", problem, "warning")
            self.trouble = problem
