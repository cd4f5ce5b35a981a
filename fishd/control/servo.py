"""The servo as the loop drives it: what it gets in each mode, and its pulses."""

import math
from collections.abc import Callable

from fishd.control.supervisor import Mode
from fishd.hardware.base import Robot


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
