"""Which of several policies swims best, with as few short swims as possible: a bandit.

Each swim gives one thrust, which is off by an error of unknown size. The next swim is chosen as in
LUCB (Kalyanakrishnan et al., "PAC subset selection in stochastic multi-armed bandits", ICML 2012):
of the policy with the highest mean, and of the one that may be better by most, the one that has
swum less often. It is enough when no other may be better by more than `NEAR`.
"""

import math
from typing import Any

from msgspec import Struct

from fishd.core.calibration import Z95
from fishd.learning.env.swims import Swim

NEAR = 0.01
"""Policies whose thrusts differ by less are equally good: a share of the best square wave's."""
MOST = 8
"""So many candidates are kept at most."""
FIRST_ERROR, FIRST_DEGREES = 0.03, 3
"""Before swims of the same policies can be compared, each is taken to have this standard deviation,
a share of the best square wave's thrust; it counts like so many comparisons."""


class Candidate(Struct, eq=False, kw_only=True):
    """A policy that may be the best, and how it has swum."""

    steps: int
    """Control steps that it has learned from."""
    updates: int
    """Passes over rollouts until then, as stable-baselines3 counts them."""
    rollouts: int
    """Updates until then."""
    parameters: dict[str, Any]
    """Of networks and optimiser."""
    swims: int = 0
    """Swims that were measured."""
    thrust: float = 0.0
    """Their mean [N]."""
    swam: float = 0.0
    """How long it has swum in all [s]."""
    frequency: float = 0.0
    """Tail beats per second in its latest swim [Hz]."""
    fullness: float = 0.0
    """Mean |φ_c|/Φ in it."""
    stalled: bool = False
    """It does not swim."""


class Candidates:
    """The policies that may be the best."""

    def __init__(self, best_thrust: float) -> None:
        """best_thrust: that of the best square wave [N]"""
        self.those: list[Candidate] = []
        self._near = NEAR * best_thrust
        self._squares = FIRST_DEGREES * (FIRST_ERROR * best_thrust) ** 2
        self._degrees = FIRST_DEGREES

    def add(self, one: Candidate) -> None:
        """One more, which may have swum before."""
        self.those.append(one)

    def count(self, one: Candidate, swim: Swim) -> None:
        """It has swum; one that stalls is out."""
        one.frequency, one.fullness, one.stalled = swim.frequency, swim.fullness, swim.stalled
        one.swam += swim.seconds
        if one.stalled:
            self.those.remove(one)
        elif swim.thrust is not None:
            if one.swims:
                self._squares += (swim.thrust - one.thrust) ** 2 * one.swims / (one.swims + 1)
                self._degrees += 1
            one.swims += 1
            one.thrust += (swim.thrust - one.thrust) / one.swims

    def error(self, one: Candidate) -> float:
        """Half of the 95 % interval of its thrust, infinite before its first swim [N].

        All swims are taken to have errors of one size, which is estimated from all policies that
        have swum more than once.
        """
        if not one.swims:
            return math.inf
        variance = self._squares / (self._degrees - 2)  # as that of Student's t distribution
        return Z95 * math.sqrt(variance / one.swims)

    @property
    def best(self) -> Candidate | None:
        """The one of which most can be promised: that with the highest lower bound."""
        return max(self._measured, key=self._lower, default=None)

    def next(self) -> Candidate | None:
        """Which one is to swim; None where it is known well enough which is the best."""
        for one in reversed(self.those):
            if not one.swims:
                return one
        first = max(self.those, key=lambda one: one.thrust, default=None)
        others = [one for one in self.those if one is not first]
        if first is None or not others:
            return None
        rival = max(others, key=self._upper)
        if self._upper(rival) <= self._lower(first) + self._near:
            return None
        return min(first, rival, key=lambda one: one.swims)

    def weed(self) -> None:
        """Forget those that can no longer be the best, and the least likely of too many."""
        least = max(map(self._lower, self._measured), default=-math.inf)
        likely = sorted(self.those, key=self._upper, reverse=True)
        kept = [one for one in likely if self._upper(one) >= least][:MOST]
        best = self.best
        self.those = [one for one in self.those if one in kept or one is best]

    @property
    def _measured(self) -> list[Candidate]:
        return [one for one in self.those if one.swims]

    def _lower(self, one: Candidate) -> float:
        return one.thrust - self.error(one)

    def _upper(self, one: Candidate) -> float:
        return one.thrust + self.error(one)
