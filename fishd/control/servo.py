"""The servo as the loop drives it: what it gets in each mode, its pulses, and its power."""

import math
from collections import deque
from collections.abc import Callable

from fishd.control.reporting import Reporter
from fishd.control.supervisor import Mode
from fishd.core import text
from fishd.hardware.base import Robot

MEAN_SPAN_S = 2.0
"""Time over which the shown power is averaged [s]: some beats."""
MIN_FAILURES = 3
"""Number of reads in a row that must fail before an event is published."""


class ServoOutput:
    """The output to the servo of a robot: sends angles, or releases the servo."""

    def __init__(self, robot: Robot, now: Callable[[], float]) -> None:
        """now: clock [s, monotonic]"""
        self.on = False
        """Whether the servo may get pulses; False once it is known to get none."""
        self.lost = False
        """Whether the servo cannot be reached; if it was on, it may still have pulses."""
        self._servo = robot.servo
        self._countdown = robot.countdown
        self.counts_down = robot.countdown < math.inf
        """Whether the servo goes to rest by itself where writes stop."""
        self._now = now
        self._written = now()

    def why_at_rest(self) -> str | None:
        """Return a line if writes stopped for longer than the countdown of a driven servo.

        The servo then is at neutral, or has no pulses any more; it must not start again by itself.
        """
        return self.why_silent() if self.on and not self.lost else None

    def why_silent(self) -> str | None:
        """Return a line if the latest write began longer ago than the countdown lasts."""
        if not self.counts_down:
            return None
        silence = self._now() - self._written
        if silence <= self._countdown:
            return None
        return (
            f"fishd stood still for {silence * 1e3:.0f} ms, and the servo has gone to neutral by "
            "itself, its pulses end within half a second: the machine is overloaded or was "
            "suspended"
        )

    def drive(self, mode: Mode, instruction_angle: float, neutral: bool) -> None:
        """Send an instruction angle [rad], or release the servo.

        It is released at once in estop, and once `neutral` in fault. In fault, pulses never begin:
        a servo that was lost is released when it can be reached again. Raises what the driver
        raises; then `lost` is True.
        """
        fading = self.on and not self.lost and not neutral
        try:
            if mode is Mode.ESTOP or (mode is Mode.FAULT and not fading):
                self._servo.release()  # in every tick, so that a lost servo is noticed
                self.on = False
            else:
                if self.counts_down:
                    self._written = self._now()
                self._servo.write(instruction_angle)
                self.on = True
        except Exception:
            self.lost = True
            raise
        self.lost = False


class ServoPower:
    """The reader of the power meter, called in each tick; keeps the latest readings.

    Where there is no power meter, or it cannot be read, the fish swims nevertheless.
    """

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
