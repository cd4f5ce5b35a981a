"""Electrical power of the servo, where there is a power meter; it is not required to swim."""

import math
from collections import deque

from fishd.control.reporting import Reporter
from fishd.core import text
from fishd.hardware.base import Robot

MEAN_SPAN_S = 2.0
"""Time over which the shown power is averaged [s]: some beats."""
MIN_FAILURES = 3
"""Number of reads in a row that must fail before an event is published."""


class ServoPower:
    """The reader of the power meter, called in each tick; keeps the latest readings."""

    def __init__(self, robot: Robot, reporter: Reporter, tick: float) -> None:
        """tick: period of the loop [s]"""
        self.trouble = ""
        """Line on why the power meter cannot be read; empty if it can, or without a power meter."""
        self.metered = robot.power is not None
        """Whether there is a power meter."""
        self._read = robot.power
        self._reporter = reporter
        self._latest: deque[float] = deque(maxlen=max(1, round(MEAN_SPAN_S / tick)))
        self._failures = 0

    @property
    def mean(self) -> float | None:
        """Mean power over the latest `MEAN_SPAN_S` [W]; None where it is not known."""
        return sum(self._latest) / len(self._latest) if self._latest else None

    def read(self, now: float) -> float | None:
        """Return the mean power since the previous tick [W]; None where it is not known.

        Never raises.

        now: start of the tick [s, monotonic]
        """
        if self._read is None:
            return None
        try:
            power = self._read(now)
            if not math.isfinite(power):
                raise ValueError(f"it gave {power} W")
        except Exception as error:
            self._note_failure(f"the power meter cannot be read: {text.describe_error(error)}")
            return None
        self._failures = 0
        if self.trouble:
            self.trouble = ""
            self._reporter.event("power", "the power meter can be read again")
        self._latest.append(power)
        return power

    def _note_failure(self, problem: str) -> None:
        self._latest.clear()
        self._failures += 1
        if self._failures >= MIN_FAILURES:
            if not self.trouble:
                self._reporter.event("power", problem, "warning")
            self.trouble = problem
