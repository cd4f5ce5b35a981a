"""When the tail is to reverse: as the fin slows down. For controllers that swim as `swing` does."""

from collections import deque

from fishd.controllers.base import Limits
from fishd.core.signals import Observation

REFRACTORY = 0.05
"""Share of the longest half period in which noise, at small ticks, cannot cause a reversal; of one
beyond 1 s it is that of 1 s: noise lasts no longer because somebody is ready to wait longer."""
FIRST_PUSH = 0.2
"""Who begins from neutral does not reverse sooner: until the servo acts, all speed is noise [s]."""
SLOPE_OVER = 0.05
"""The speed ahead is predicted from its change over this time, or a tick if that is longer [s]."""


class Reversal:
    """Which way to push: the other one once the fin slows to a fraction C of its top speed."""

    def __init__(self, limits: Limits) -> None:
        self.top_speed = 0.0
        """The fin's highest in a half beat: of this one, once past it; before, of the last."""
        self.reversal_speed = 0.0
        """C times that."""
        self.since_reversal = 0.0
        """[s]"""
        self.direction = 1.0
        """1 or -1."""
        self._tick = limits.tick
        self._first = False
        """Has it begun from neutral, and not reversed yet?"""
        self._top_speed = 0.0  # since the last reversal
        ticks = max(1, round(SLOPE_OVER / limits.tick))
        self._velocities: deque[float] = deque(maxlen=ticks + 1)

    def begin(self, angle: float) -> None:
        """Push on towards the side of this angle; from 0, towards plus."""
        self.direction = 1.0 if angle >= 0 else -1.0
        self._first = angle == 0.0

    def update(self, observation: Observation, C: float, lead: float, longest: float) -> None:
        """Take in a tick.

        C: share of the top speed
        lead: the speed that counts is predicted so far ahead [s]
        longest: half period after which it reverses in any case [s]
        """
        self.since_reversal += observation.dt
        velocities = self._velocities
        velocities.append(observation.fin_velocity)
        speed = self.direction * observation.fin_velocity
        if lead and len(velocities) > 1:  # the speed ahead, if it goes on changing as it does
            elapsed = observation.dt * (len(velocities) - 1)
            speed += self.direction * lead * (velocities[-1] - velocities[0]) / elapsed
        slowed = self._top_speed > 0.0 and speed <= C * self._top_speed
        if speed > self._top_speed:
            self._top_speed = speed
        # Half a tick early is nearer to the longest half period than half a tick late.
        nearly = self.since_reversal + 0.5 * self._tick
        settled = self.since_reversal > REFRACTORY * (longest if longest < 1.0 else 1.0)
        if self._first:
            settled = settled and nearly > FIRST_PUSH
        overdue = nearly > longest
        reverses = (slowed and settled) or overdue
        if self._top_speed > 0.0 and (reverses or speed < self._top_speed):
            self.top_speed = self._top_speed
        if reverses:
            self.direction, self._first = -self.direction, False
            self._top_speed = 0.0
            self.since_reversal = 0.0
        self.reversal_speed = C * self.top_speed
