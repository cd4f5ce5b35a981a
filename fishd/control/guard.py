"""Limits on what reaches the servo: finite angles within the range, no faster than permitted."""

import math
from typing import Any

from fishd.core.foreign_code import call_foreign, real_number


class Guard:
    """A limiter of the instruction angle without a memory, so nothing can wind up."""

    def __init__(
        self, amplitude: float, tick: float, slew_limit: float | None, fade_time: float
    ) -> None:
        """Permit every angle within ±Φ until `restrict` is called.

        amplitude: Φ [rad]
        tick: period of the loop [s]
        slew_limit: fastest permitted change [rad/s]; None permits one full reversal a tick
        fade_time: time of a fade from Φ to neutral [s]
        """
        self._amplitude = amplitude
        self.restrict(-amplitude, amplitude)
        full_reversal = 2 * amplitude
        self.step = full_reversal if slew_limit is None else min(full_reversal, slew_limit * tick)
        """Largest change per tick while a controller is active [rad]."""
        self.fade_step = min(self.step, amplitude * tick / fade_time)
        """Largest change per tick while fading to neutral [rad]."""

    def restrict(self, lowest: float, highest: float) -> None:
        """Permit only angles from `lowest` to `highest` [rad], and never any beyond ±Φ."""
        self.lowest = max(-self._amplitude, lowest)
        """Lowest permitted angle [rad]."""
        self.highest = min(self._amplitude, highest)
        """Highest permitted angle [rad]."""

    def apply(self, chosen: Any, previous: float) -> float:
        """Return the instruction angle to send [rad].

        chosen: the controller's [rad]: a real number of any type, numpy's too
        previous: the one that was sent in the previous tick [rad]
        Raises ValueError when `chosen` is not a number, or not finite.
        """
        is_float = type(chosen) is float
        permitted = (
            chosen if is_float else call_foreign(real_number, chosen, "the instruction angle")
        )
        if not math.isfinite(permitted):
            raise ValueError(f"the instruction angle is {permitted}, not a finite number")
        if permitted > self.highest:
            permitted = self.highest
        elif permitted < self.lowest:
            permitted = self.lowest
        return _step_towards(permitted, previous, self.step)

    def fade(self, previous: float) -> float:
        """Return the next instruction angle on the way to neutral [rad]."""
        return _step_towards(0.0, previous, self.fade_step)


def _step_towards(wanted: float, previous: float, step: float) -> float:
    reach = step * (1.0 + 1e-9)  # rounding must not cost another tick
    if wanted > previous + reach:
        return previous + step
    if wanted < previous - reach:
        return previous - step
    return wanted
