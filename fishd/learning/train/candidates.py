"""Selection of the policy that swims best, with as few short swims as possible: a bandit.

Each swim gives one thrust, with an error of unknown size. The policy of the next swim is chosen as
in LUCB (Kalyanakrishnan et al., "PAC subset selection in stochastic multi-armed bandits", ICML
2012): of the policy with the highest mean, and of the one with the highest upper bound among the
others, the one that has swum less often. The search ends when no other policy may be better by more
than `EQUAL_SHARE`.
"""

import math
from typing import Any

from msgspec import Struct

from fishd.core.calibration import Z95
from fishd.learning.env.swims import Swim

EQUAL_SHARE = 0.01
"""Difference of thrust below which policies are equally good, as a share of the best square
wave's."""
MAX_CANDIDATES = 8
"""Largest number of candidates."""
PRIOR_ERROR, PRIOR_DEGREES = 0.03, 3
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
        self.remaining: list[Candidate] = []
        self._equal = EQUAL_SHARE * best_thrust
        self._squares = PRIOR_DEGREES * (PRIOR_ERROR * best_thrust) ** 2
        self._degrees = PRIOR_DEGREES

    def add(self, candidate: Candidate) -> None:
        """Add a candidate, which may have swum before."""
        self.remaining.append(candidate)

    def add_swim(self, candidate: Candidate, swim: Swim) -> None:
        """Add a swim to the figures of a candidate; remove the candidate if it stalls."""
        candidate.frequency, candidate.fullness, candidate.stalled = (
            swim.frequency,
            swim.fullness,
            swim.stalled,
        )
        candidate.swam += swim.seconds
        if candidate.stalled:
            self.remaining.remove(candidate)
        elif swim.thrust is not None:
            if candidate.swims:
                self._squares += (
                    (swim.thrust - candidate.thrust) ** 2 * candidate.swims / (candidate.swims + 1)
                )
                self._degrees += 1
            candidate.swims += 1
            candidate.thrust += (swim.thrust - candidate.thrust) / candidate.swims

    def ci95(self, candidate: Candidate) -> float:
        """Return the half-width of the 95 % interval of its thrust, infinite before a swim [N].

        The errors of all swims are assumed to have the same standard deviation, which is estimated
        from all policies that have swum more than once.
        """
        if not candidate.swims:
            return math.inf
        variance = self._squares / (self._degrees - 2)  # as that of Student's t distribution
        return Z95 * math.sqrt(variance / candidate.swims)

    @property
    def best(self) -> Candidate | None:
        """Candidate with the highest lower bound of its thrust; None before the first swim."""
        return max(self._measured, key=self._lower, default=None)

    def next(self) -> Candidate | None:
        """Return the candidate of the next swim; None where the best is known well enough."""
        for candidate in reversed(self.remaining):
            if not candidate.swims:
                return candidate
        first = max(self.remaining, key=lambda candidate: candidate.thrust, default=None)
        others = [candidate for candidate in self.remaining if candidate is not first]
        if first is None or not others:
            return None
        rival = max(others, key=self._upper)
        if self._upper(rival) <= self._lower(first) + self._equal:
            return None
        return min(first, rival, key=lambda candidate: candidate.swims)

    def remove_unlikely(self) -> None:
        """Remove candidates that can no longer be the best; keep at most `MAX_CANDIDATES`."""
        bound = max(map(self._lower, self._measured), default=-math.inf)
        likely = sorted(self.remaining, key=self._upper, reverse=True)
        kept = [candidate for candidate in likely if self._upper(candidate) >= bound][
            :MAX_CANDIDATES
        ]
        best = self.best
        self.remaining = [
            candidate for candidate in self.remaining if candidate in kept or candidate is best
        ]

    @property
    def _measured(self) -> list[Candidate]:
        return [candidate for candidate in self.remaining if candidate.swims]

    def _lower(self, candidate: Candidate) -> float:
        return candidate.thrust - self.ci95(candidate)

    def _upper(self, candidate: Candidate) -> float:
        return candidate.thrust + self.ci95(candidate)
