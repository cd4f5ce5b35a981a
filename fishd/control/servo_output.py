"""The servo as the loop drives it: what it gets in which mode, and what is known of its pulses."""

from collections.abc import Callable

from fishd.hardware.base import Robot
from fishd.supervisor import Mode


class Drive:
    """Sends angles to the servo of a robot, or releases it."""

    def __init__(self, robot: Robot, now: Callable[[], float]) -> None:
        """now: the time [s, monotonic]"""
        self.on = False
        """False once the servo is known to get no pulses."""
        self.lost = False
        """True while the servo cannot be reached: if it was on, it may still have pulses."""
        self._servo = robot.servo
        self._countdown = robot.countdown
        self._now = now
        self._written = now()

    def silence(self) -> float:
        """Time since the latest write, where the servo ends its pulses because of it; else 0 [s].

        Such a servo is at neutral, or has no pulses any more: it must not begin again by itself.
        """
        silence = self._now() - self._written
        return silence if self.on and not self.lost and silence > self._countdown else 0.0

    def command(self, mode: Mode, angle: float, neutral: bool) -> None:
        """Send an angle [rad], or release the servo: at once in estop, once `neutral` in fault.

        In fault pulses never begin: a servo that was lost is released when it is back. Raises what
        the driver raises; the servo is lost then.
        """
        fading = self.on and not self.lost and not neutral
        try:
            if mode is Mode.ESTOP or (mode is Mode.FAULT and not fading):
                self._servo.release()  # in every tick: so a servo that is lost is noticed
                self.on = False
            else:
                self._written = self._now()
                self._servo.write(angle)
                self.on = True
        except Exception:
            self.lost = True
            raise
        self.lost = False
