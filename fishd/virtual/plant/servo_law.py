"""Motion of the servo's wheel towards a constant instruction, for laws other than φ̇ = Ω tanh(e/Δ).

The distance e to the instruction is in units of Δ, a speed in units of Ω, and a time in units of
Δ/Ω. The wheel runs at Ω where e is large, and slows down in three ways:

    linear:        φ̇ = e for |e| < 1, an exponential approach
    square-root:   φ̇ = √|e| for |e| < 1, a constant deceleration of 1/2
    accelerating:  the same, and the wheel gains its speed with that acceleration, too, as in the
                   fastest motion between two positions at rest with bounded speed and acceleration
"""

import math
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Vector: TypeAlias = NDArray[np.float64]
ServoLaw: TypeAlias = Literal["tanh", "linear", "square-root", "accelerating"]
LAWS: tuple[ServoLaw, ...] = get_args(ServoLaw)
_MIN_SPEED = 1e-9
"""Smallest speed that is not treated as zero."""


class Approach:
    """Motion from a distance, at first at a speed, until the wheel rests at its instruction."""

    def __init__(self, law: ServoLaw, distance: float, speed: float) -> None:
        """speed: positive towards a positive distance; only an accelerating wheel keeps it"""
        sign = math.copysign(1.0, distance)
        self._is_linear = law == "linear"
        if law != "accelerating":
            size = abs(distance)
            top = min(size, 1.0) if self._is_linear else math.sqrt(min(size, 1.0))
            speed = sign * top
        elif abs(speed) < _MIN_SPEED:
            speed = 0.0
        elif sign * speed > 0.0 and speed * speed > abs(distance):
            sign = -sign  # it cannot stop in time: it passes its instruction and comes back
        self._sign = sign
        """Direction of the second part of the motion, towards the instruction."""
        self._start, self._speed = start, speed = sign * distance, sign * speed
        self._top = min(1.0, math.sqrt(max(0.0, 0.5 * (start + speed * speed))))
        if law != "accelerating":
            self._top = top
        top = self._top
        self._gained = 2.0 * (top - speed)
        """Time until the wheel has its highest speed."""
        self._left = start - top * top + speed * speed
        """Distance that is left then."""
        braking = top if self._is_linear else top * top
        self._slows = self._gained + ((self._left - braking) / top if top else 0.0)
        """Time at which it begins to slow down."""
        self._braking = braking

    @property
    def turn(self) -> float:
        """Time at which the wheel, at first moving away, turns; 0 where it does not."""
        return max(0.0, -2.0 * self._speed)

    @property
    def first_speed(self) -> float:
        """Speed at the start."""
        return self._sign * self._speed

    @property
    def kinks(self) -> tuple[float, ...]:
        """Times at which the acceleration jumps."""
        if self._is_linear:
            return (self._slows,)
        return (self._gained, self._slows, self._slows + 2.0 * self._top)

    def at(self, times: "Vector") -> tuple["Vector", "Vector", "Vector"]:
        """Return distances, speeds and the derivatives of the speeds at these times."""
        import numpy as np  # the configuration imports this module, and needs no numpy

        late = np.maximum(times - self._slows, 0.0)
        if self._is_linear:
            speeds = self._top * np.exp(-late)
            distances, changes = speeds, np.where(late > 0.0, -speeds, 0.0)
        else:
            speeds = np.maximum(self._top - 0.5 * late, 0.0)
            distances = speeds * speeds
            changes = np.where((late > 0.0) & (speeds > 0.0), -0.5, 0.0)
        distances = distances + self._top * np.maximum(self._slows - times, 0.0)
        if self._gained:
            early = times < self._gained
            gain = self._speed + 0.5 * times
            distances = np.where(early, self._start + self._speed**2 - gain * gain, distances)
            speeds, changes = np.where(early, gain, speeds), np.where(early, 0.5, changes)
        return self._sign * distances, self._sign * speeds, self._sign * changes

    def time_to(self, distance: float) -> float:
        """Return the time at which the wheel is first at a distance that it passes."""
        distance *= self._sign
        if distance > self._left or self._speed < 0.0:
            root = math.sqrt(max(0.0, self._start + self._speed**2 - distance))
            return 2.0 * ((-root if self._speed < 0.0 else root) - self._speed)
        if distance >= self._braking:
            return self._gained + (self._left - distance) / self._top
        if self._is_linear:
            return self._slows + math.log(self._top / distance)
        return self._slows + 2.0 * (self._top - math.sqrt(distance))
