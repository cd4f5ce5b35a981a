"""Selection of the policy that swims best, with as few short swims as possible: a bandit.

Each swim gives one thrust, with an error of unknown size. The policy of the next swim is chosen as
in LUCB (Kalyanakrishnan et al., "PAC subset selection in stochastic multi-armed bandits", ICML
2012): of the policy with the highest mean, and of the one with the highest upper bound among the
others, the one that has swum less often. The search ends when no other policy may be better by more
than `NEAR`.
"""

import math
from typing import Any

from msgspec import Struct

from fishd.core.calibration import Z95
from fishd.learning.env.swims import Swim

NEAR = 0.01
"""Difference of thrust below which policies are equally good, as a share of the best square
wave's."""
MOST = 8
"""Largest number of candidates."""
FIRST_ERROR, FIRST_DEGREES = 0.03, 3
"""Prior standard deviation of a swim, as a share of the best square wave's thrust, and its weight
as a number of comparisons of swims of the same policy."""


class Candidate(Struct, eq=False, kw_only=True):
    """A policy that may be the best, and the figures of its swims."""

    steps: int
    """Number of control steps that it has learned from."""
    updates: int
    """Number of passes over rollouts until then, as stable-baselines3 counts them."""
    rollouts: int
    """Number of updates until then."""
    parameters: dict[str, Any]
    """Parameters of networks and optimiser."""
    swims: int = 0
    """Number of measured swims."""
    thrust: float = 0.0
    """Mean thrust of the measured swims [N]."""
    swam: float = 0.0
    """Total time of all swims [s]."""
    frequency: float = 0.0
    """Tail beats per second in its latest swim [Hz]."""
    fullness: float = 0.0
    """Mean |φ_c|/Φ in the latest swim."""
    stalled: bool = False
    """Whether the policy stalls instead of swimming."""


class Candidates:
    """The policies that may be the best."""

    def __init__(self, best_thrust: float) -> None:
        """best_thrust: thrust of the best square wave [N]"""
        self.those: list[Candidate] = []
        self._near = NEAR * best_thrust
        self._squares = FIRST_DEGREES * (FIRST_ERROR * best_thrust) ** 2
        self._degrees = FIRST_DEGREES

    def add(self, one: Candidate) -> None:
        """Add a candidate, which may have swum before."""
        self.those.append(one)

    def count(self, one: Candidate, swim: Swim) -> None:
        """Add a swim to the figures of a candidate; remove the candidate if it stalls."""
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
        """Return the half-width of the 95 % interval of its thrust, infinite before a swim [N].

        The errors of all swims are assumed to have the same standard deviation, which is estimated
        from all policies that have swum more than once.
        """
        if not one.swims:
            return math.inf
        variance = self._squares / (self._degrees - 2)  # as that of Student's t distribution
        return Z95 * math.sqrt(variance / one.swims)

    @property
    def best(self) -> Candidate | None:
        """Candidate with the highest lower bound of its thrust; None before the first swim."""
        return max(self._measured, key=self._lower, default=None)

    def next(self) -> Candidate | None:
        """Return the candidate of the next swim; None where the best is known well enough."""
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
        """Remove candidates that can no longer be the best, and the least likely beyond `MOST`."""
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
