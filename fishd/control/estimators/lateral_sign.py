"""A check of the sign of F_y, at each start of the tail from rest.

The water pushes back on a fin that starts to move, so F_y points against the first push: its
impulse since then is −(K α̇ + K_d α), and both terms grow with the fin on its way to that side (Fu
et al., F_y). Once the fish swims, the sign cannot be determined any more: a reversed F_y looks like
one half a beat later. Where F_y or the direction of the servo is reversed, the fin velocity is
reversed too, and a controller that uses it reverses at the wrong moments.
"""

import math
from collections import deque
from typing import Literal

from fishd.core.signals import Observation

SETTLE_TIME_S = 1.0
"""Time without a movement of the tail after which the fin is still [s]."""
MIN_REST_S, MAX_REST_S = 0.5, 1.0
"""Shortest and longest rest after that, from which offset and noise of F_y are estimated [s]."""
MAX_PUSH_S = 0.4
"""Longest part of the first push that is evaluated [s]."""
MIN_PUSH_S = 0.15
"""Shortest push that is evaluated: the servo may not have reacted to a shorter one [s]."""
SERVO_DELAY_S = 0.05
"""Time that a push continues after its instruction, due to the delay of the servo [s]."""
LARGER_PUSH_RATIO = 3.0
"""Ratio to the largest previous angle from which a push starts again: a policy may begin with
small movements."""
MIN_CLEARNESS = 10.0
"""Smallest clear impulse, in standard deviations of its noise."""
MIN_DIRECTEDNESS = 0.5
"""Smallest ratio of the mean impulse to its mean size; a reaction of the servo alone has less."""
MAX_VOTES = 2
"""Largest number of clear pushes that count for a reversed F_y or against it."""
MIN_NOISE_N = 1e-6
"""Smallest assumed noise of F_y [N]."""
Treatment = Literal["correct", "refuse", "warn"]
"""Consequence of a reversed F_y, see `estimator.reversed_fy`."""
CONSEQUENCES: dict[Treatment, str] = {
    "correct": "so controllers are shown it with the other sign",
    "refuse": "so controllers that use it are refused",
    "warn": "so swing and policies fail",
}


class LateralSign:
    """The sign of F_y, determined from the first push of each start from rest.

    The first clear push decides at once. Each later one is a vote, so a disturbance during one of
    them does not change the sign. With one vote on either side, the right sign wins.
    """

    def __init__(self, treatment: Treatment = "correct") -> None:
        self.treatment = treatment
        self.forget()

    def forget(self) -> None:
        """Discard all pushes, since the calibration of the sensor or of the servo was changed."""
        self.reversed: bool | None = None
        """Whether the measured F_y is reversed; None before the first clear push."""
        self.corrected = False
        """Whether the sign of F_y is to be reversed before use."""
        self.refuses = False
        """Whether controllers that use F_y are refused."""
        self._votes = 0  # number of clear pushes for a reversed F_y, less that of the others
        self.rest()

    def rest(self) -> None:
        """Require a new rest, since the zero of the sensor was changed or a force is suspect."""
        self._still = 0.0
        self._rest: deque[tuple[float, float]] = deque()  # (F_y [N], duration [s])
        self._rested = 0.0
        self._push: _Push | None = None
        self._largest = 0.0

    @property
    def complaint(self) -> str | None:
        """Line with the problem and its remedy; None unless F_y is reversed."""
        if not self.reversed:
            return None
        return (
            "F_y is reversed: it pushed in the direction in which the tail began to move, "
            f"{CONSEQUENCES[self.treatment]}; where a positive angle moves the tail to the fish's "
            "left, mend F_y with 'fishctl calibrate force' (+y pulls to its left), else "
            "servo.direction with 'fishctl calibrate servo'"
        )

    def update(self, seen: Observation, fy: float) -> bool:
        """Take in a tick; return whether it changed the sign.

        fy: measured F_y [N]; that of the observation may be corrected
        """
        if self._push is None:
            if seen.instruction_angle == 0.0:
                self._at_rest(seen, fy)
                return False
            if self._rested < MIN_REST_S:
                if self._still:
                    self.rest()
                return False
            self._push = _Push(seen.instruction_angle, *self._level())
        size = abs(seen.instruction_angle)
        if size > LARGER_PUSH_RATIO * self._largest > 0.0:
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
        if self._still <= SETTLE_TIME_S:
            return
        self._rest.append((fy, seen.dt))
        self._rested += seen.dt
        while self._rested > MAX_REST_S + 0.5 * seen.dt:
            self._rested -= self._rest.popleft()[1]

    def _level(self) -> tuple[float, float, float]:
        """Return the mean of F_y at rest [N], its noise [N √s], and the length of the rest [s]."""
        time = self._rested
        level = sum(fy * dt for fy, dt in self._rest) / time
        power = sum((fy - level) ** 2 * dt for fy, dt in self._rest) / time
        mean_dt = time / len(self._rest)
        return level, math.sqrt((power + MIN_NOISE_N**2) * mean_dt), time


class _Push:
    """The push of F_y since the tail started to move."""

    def __init__(self, instruction_angle: float, level: float, noise: float, rested: float) -> None:
        self._side = math.copysign(1.0, instruction_angle)
        self._level, self._noise, self._rested = level, noise, rested
        self._over = False
        self._time = self._pushed = self._lasted = 0.0
        self._impulse = self._sum = self._size = 0.0

    def add(self, seen: Observation, fy: float) -> bool:
        """Take in a tick; return False once the push is over."""
        self._over = self._over or self._side * seen.instruction_angle <= 0.0
        self._time += seen.dt
        if not self._over:
            self._pushed = self._time
        late = self._time - self._pushed > SERVO_DELAY_S + 1e-9
        if late or self._time > MAX_PUSH_S + 1e-9:
            return False
        self._impulse -= self._side * (fy - self._level) * seen.dt
        self._sum += self._impulse * seen.dt
        self._size += abs(self._impulse) * seen.dt
        self._lasted = self._time
        return True

    @property
    def reversed(self) -> bool | None:
        """Whether the push shows a reversed F_y; None where it is not clear."""
        if self._pushed < MIN_PUSH_S - 1e-9 or not self._lasted:  # or one long tick took all of it
            return None
        lasted = self._lasted
        # Standard deviation of the sum of the impulse, from white noise and the error of the level.
        error = self._noise * math.sqrt(lasted**3 / 3.0 + lasted**4 / (4.0 * self._rested))
        clear = abs(self._sum) > MIN_CLEARNESS * error
        return self._sum < 0.0 if clear and abs(self._sum) > MIN_DIRECTEDNESS * self._size else None
