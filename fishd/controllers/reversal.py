"""Detection of the time to reverse, as the fin slows down, for controllers such as `swing`."""

from collections import deque

from fishd.controllers.base import Limits
from fishd.core.signals import Observation

REFRACTORY_FRACTION = 0.05
"""Fraction of the longest half period, but of at most 1 s, during which no reversal is possible, so
that noise at small ticks does not cause one."""
MIN_FIRST_PUSH_S = 0.2
"""Minimum time to the first reversal from neutral: until the servo acts, all speed is noise [s]."""
SLOPE_WINDOW_S = 0.05
"""Time over which the change of speed is measured for the prediction; at least one tick [s]."""


class Reversal:
    """Direction of the push, which reverses when the fin slows to a fraction C of its top speed."""

    def __init__(self, limits: Limits) -> None:
        self.top_speed = 0.0
        """Top speed of the fin in this half beat, or, until it is reached, in the previous one."""
        self.reversal_speed = 0.0
        """C times `top_speed`."""
        self.since_reversal = 0.0
        """Time since the last reversal [s]."""
        self.direction = 1.0
        """Direction of the push, 1 or -1."""
        self._tick = limits.tick
        self._first = False
        """Whether it began from neutral and has not reversed yet."""
        self._top_speed = 0.0  # since the last reversal
        ticks = max(1, round(SLOPE_WINDOW_S / limits.tick))
        self._velocities: deque[float] = deque(maxlen=ticks + 1)

    def begin(self, instruction_angle: float) -> None:
        """Push towards the side of this angle; from 0, towards plus."""
        self.direction = 1.0 if instruction_angle >= 0 else -1.0
        self._first = instruction_angle == 0.0

    def update(self, observation: Observation, C: float, lead: float, longest: float) -> None:
        """Process a tick.

        C: fraction of the top speed
        lead: time by which the compared speed is predicted ahead [s]
        longest: half period after which it reverses in any case [s]
        """
        self.since_reversal += observation.dt
        velocities = self._velocities
        velocities.append(observation.fin_velocity)
        speed = self.direction * observation.fin_velocity
        if lead and len(velocities) > 1:  # predict the speed with a constant slope
            elapsed = observation.dt * (len(velocities) - 1)
            speed += self.direction * lead * (velocities[-1] - velocities[0]) / elapsed
        slowed = self._top_speed > 0.0 and speed <= C * self._top_speed
        if speed > self._top_speed:
            self._top_speed = speed
        # Rounds the longest half period to the nearest tick.
        rounded_time = self.since_reversal + 0.5 * self._tick
        may_reverse = self.since_reversal > REFRACTORY_FRACTION * (
            longest if longest < 1.0 else 1.0
        )
        if self._first:
            may_reverse = may_reverse and rounded_time > MIN_FIRST_PUSH_S
        overdue = rounded_time > longest
        reverses = (slowed and may_reverse) or overdue
        if self._top_speed > 0.0 and (reverses or speed < self._top_speed):
            self.top_speed = self._top_speed
        if reverses:
            self.direction, self._first = -self.direction, False
            self._top_speed = 0.0
            self.since_reversal = 0.0
        self.reversal_speed = C * self.top_speed
