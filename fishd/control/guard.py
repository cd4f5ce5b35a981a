"""The last word on what reaches the servo: finite, within its limits, no faster than permitted."""

import math
from typing import Any

from fishd.core.foreign_code import contained, real_number


class Guard:
    """Limits the instruction angle. It remembers no command, so nothing can wind up."""

    def __init__(
        self, amplitude: float, tick: float, slew_limit: float | None, fade_time: float
    ) -> None:
        """Permits every angle within ±Φ until `restrict` is called.

        amplitude: Φ [rad]
        tick: period of the loop [s]
        slew_limit: fastest permitted change [rad/s]; None permits one full reversal a tick
        fade_time: how long a fade from Φ to neutral takes [s]
        """
        self._amplitude = amplitude
        self.restrict(-amplitude, amplitude)
        full_reversal = 2 * amplitude
        self.step = full_reversal if slew_limit is None else min(full_reversal, slew_limit * tick)
        """Largest change per tick while a controller is active [rad]."""
        self.fade_step = min(self.step, amplitude * tick / fade_time)
        """Largest change per tick while fading to neutral [rad]."""

    def restrict(self, lowest: float, highest: float) -> None:
        """Permit angles from `lowest` to `highest` [rad] only, as far as they are within ±Φ."""
        self.lowest = max(-self._amplitude, lowest)
        """The lowest angle that is permitted [rad]."""
        self.highest = min(self._amplitude, highest)
        """The highest angle that is permitted [rad]."""

    def apply(self, command: Any, previous: float) -> float:
        """The instruction angle to send [rad].

        command: what the controller wants [rad]: one real number of any kind, numpy's too
        previous: the angle that is applied now [rad]
        Raises ValueError when the command is no number, or not finite.
        """
        known = type(command) is float
        angle = command if known else contained(real_number, command, "the command")
        if not math.isfinite(angle):
            raise ValueError(f"the command is {angle}, not an angle")
        if angle > self.highest:
            angle = self.highest
        elif angle < self.lowest:
            angle = self.lowest
        return _towards(angle, previous, self.step)

    def fade(self, previous: float) -> float:
        """The next instruction angle on the way to neutral [rad]."""
        return _towards(0.0, previous, self.fade_step)


def _towards(wanted: float, previous: float, step: float) -> float:
    reach = step * (1.0 + 1e-9)  # rounding must not cost another tick
    if wanted > previous + reach:
        return previous + step
    if wanted < previous - reach:
        return previous - step
    return wanted
