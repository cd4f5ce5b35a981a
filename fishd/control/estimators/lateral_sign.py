"""Does F_y have the right sign? Seen when the tail sets off from rest.

The water pushes back on a fin that sets off, so F_y points against the first push: its impulse
since then is −(K α̇ + K_d α), and both grow with the fin on its way to that side (Fu et al., F_y).
Once the fish swims, the sign cannot be told any more: half a beat later is the same as the other
way round. Where F_y is reversed, or the servo turns the other way, the fin velocity is, too, and
a controller that uses it reverses at the wrong moments.
"""

import math
from collections import deque
from typing import Literal

from fishd.core.signals import Observation

SETTLES = 1.0
"""A fin hangs still when nothing has moved the tail for so long [s]."""
LEAST_REST, MOST_REST = 0.5, 1.0
"""Rest after that by which the offset and the noise of F_y are known, at least and at most [s]."""
LONGEST = 0.4
"""So much of the first push counts [s]."""
SHORTEST = 0.15
"""A push that was shorter tells nothing: the servo may not have noticed it yet [s]."""
AFTER = 0.05
"""How long a push goes on after its end, by the servo's delay [s]."""
LARGER = 3.0
"""One that is so many times larger begins anew: a policy may tremble before it swims."""
CLEAR = 10.0
"""The impulse must be so many times what noise makes of it."""
ONE_WAY = 0.5
"""And point one way in most of the push, as a servo's own reaction may not: mean over mean size."""
MAX_VOTES = 2
"""Clear pushes that count at most, for a reversed F_y or against it."""
LEAST_NOISE = 1e-6
"""No force is known better [N]."""
Treatment = Literal["correct", "refuse", "warn"]
"""What follows from a reversed F_y: see `estimator.reversed_fy`."""
CONSEQUENCES: dict[Treatment, str] = {
    "correct": "so controllers are shown it with the other sign",
    "refuse": "so controllers that use it are refused",
    "warn": "so swing and policies fail",
}


class LateralSign:
    """Watches the first push of each start from rest.

    The first clear push decides at once. Each later one is a vote: so a force from elsewhere that
    comes with one of them turns nothing round, and of one vote on either side the right sign wins.
    """

    def __init__(self, treatment: Treatment = "correct") -> None:
        self.treatment = treatment
        self.forget()

    def forget(self) -> None:
        """The calibration of the sensor or of the servo was changed: nothing seen so far holds."""
        self.reversed: bool | None = None
        """Whether F_y is reversed as it is measured; None while no clear push was seen."""
        self.corrected = False
        """Whether F_y is to be taken with the other sign."""
        self.refuses = False
        """Whether controllers that use F_y may not swim."""
        self._votes = 0  # of clear pushes, for a reversed F_y
        self.rest()

    def rest(self) -> None:
        """The sensor's zero was changed, or a force is in doubt: the fish must rest anew."""
        self._still = 0.0
        self._rest: deque[tuple[float, float]] = deque()  # (F_y [N], duration [s])
        self._rested = 0.0
        self._push: _Push | None = None
        self._largest = 0.0

    @property
    def complaint(self) -> str:
        """One line: what is wrong and what to do; empty where F_y was not seen to be reversed."""
        if not self.reversed:
            return ""
        return (
            "F_y is reversed: it pushed the way in which the tail set off, "
            f"{CONSEQUENCES[self.treatment]}; where a positive angle moves the tail to the fish's "
            "left, mend F_y with 'fishctl calibrate force' (+y pulls to its left), else "
            "servo.direction with 'fishctl calibrate servo'"
        )

    def update(self, seen: Observation, fy: float) -> bool:
        """Take in a tick; True where another sign holds from now on than before.

        fy: F_y as it is measured [N]; that of the observation may be corrected
        """
        if self._push is None:
            if seen.instruction_angle == 0.0:
                self._at_rest(seen, fy)
                return False
            if self._rested < LEAST_REST:
                if self._still:
                    self.rest()
                return False
            self._push = _Push(seen.instruction_angle, *self._level())
        size = abs(seen.instruction_angle)
        if size > LARGER * self._largest > 0.0:
            self._push = _Push(seen.instruction_angle, *self._level())
        self._largest = max(self._largest, size)
        if self._push.add(seen, fy):
            return False
        verdict = self._push.reversed
        self.rest()
        if verdict is None:
            return False
        votes = self._votes + (1 if verdict else -1)
        self._votes = max(-MAX_VOTES, min(MAX_VOTES, votes))
        before, self.reversed = self.reversed, self._votes > 0
        self.corrected = self.reversed and self.treatment == "correct"
        self.refuses = self.reversed and self.treatment == "refuse"
        return self.reversed is not before

    def _at_rest(self, seen: Observation, fy: float) -> None:
        self._still += seen.dt
        if self._still <= SETTLES:
            return
        self._rest.append((fy, seen.dt))
        self._rested += seen.dt
        while self._rested > MOST_REST + 0.5 * seen.dt:
            self._rested -= self._rest.popleft()[1]

    def _level(self) -> tuple[float, float, float]:
        """Mean of F_y at rest [N], its noise [N √s], and for how long it was looked at [s]."""
        time = self._rested
        level = sum(fy * dt for fy, dt in self._rest) / time
        power = sum((fy - level) ** 2 * dt for fy, dt in self._rest) / time
        each = time / len(self._rest)
        return level, math.sqrt((power + LEAST_NOISE**2) * each), time


class _Push:
    """F_y from the moment when the tail set off."""

    def __init__(self, angle: float, level: float, noise: float, rested: float) -> None:
        self._side = math.copysign(1.0, angle)
        self._level, self._noise, self._rested = level, noise, rested
        self._over = False
        self._time = self._pushed = self._lasted = 0.0
        self._impulse = self._sum = self._size = 0.0

    def add(self, seen: Observation, fy: float) -> bool:
        """Take in a tick; False once the push is over."""
        self._over = self._over or self._side * seen.instruction_angle <= 0.0
        self._time += seen.dt
        if not self._over:
            self._pushed = self._time
        late = self._time - self._pushed > AFTER + 1e-9
        if late or self._time > LONGEST + 1e-9:
            return False
        self._impulse -= self._side * (fy - self._level) * seen.dt
        self._sum += self._impulse * seen.dt
        self._size += abs(self._impulse) * seen.dt
        self._lasted = self._time
        return True

    @property
    def reversed(self) -> bool | None:
        """What it showed; None where that is nothing."""
        if self._pushed < SHORTEST - 1e-9 or not self._lasted:  # or a hang took all of it
            return None
        lasted = self._lasted
        # Of the impulse, summed: white noise, and the error of the level that was taken off.
        error = self._noise * math.sqrt(lasted**3 / 3.0 + lasted**4 / (4.0 * self._rested))
        clear = abs(self._sum) > CLEAR * error
        return self._sum < 0.0 if clear and abs(self._sum) > ONE_WAY * self._size else None
