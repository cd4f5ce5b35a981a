"""Ranking of gaits by thrust with confidence intervals, for compare and adapt.

A gait is excluded where the thrust of another one is larger by more than the half-width of their
difference. The intervals of all pairs hold together in 95 % of cases (Bonferroni), whichever gait
is the best one. The remaining gaits are undecided, and the simplest of them is chosen.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from fishd.lab.statistics import quantile, student95

LEVEL = 0.05
"""Probability that any of the simultaneous intervals fails."""
EXACT_TOLERANCE = 1e-4
"""Largest relative difference of two exact thrusts that count as equal."""
_OPEN_LOOP = frozenset(("hold", "square", "sine", "triangle", "excitation"))


class Candidate(NamedTuple):
    """A gait with its measured thrust."""

    name: str
    thrust: float
    """Mean thrust [N]."""
    ci95: float
    """Half-width of the 95 % interval of `thrust`, without calibration; 0 for an exact one [N]."""
    complexity: int
    """Complexity of the controller: see `complexity`."""
    freedom: float = math.inf
    """Degrees of freedom of the interval, for Student's t."""


class Ranking(NamedTuple):
    """The gaits that may be the best one, and the choice among them."""

    undecided: tuple[Candidate, ...]
    """Gaits that no other one excludes, the simplest first, then by decreasing thrust."""

    @property
    def is_decided(self) -> bool:
        """True where only one gait is not excluded."""
        return len(self.undecided) == 1

    @property
    def chosen(self) -> Candidate:
        """The simplest of the undecided gaits."""
        return self.undecided[0]

    @property
    def reason(self) -> str:
        """Reason for the choice, as a clause."""
        simplest = [gait for gait in self.undecided if gait.complexity == self.chosen.complexity]
        if len(simplest) == 1:
            return "it is the simplest"
        if len(simplest) < len(self.undecided):
            return "it thrusts most of the simplest ones"
        return "all are equally simple, and it thrusts most"


def complexity(controller: str) -> int:
    """Return 0 for a given wave, 1 for a law with force feedback, 2 for a policy."""
    if controller in _OPEN_LOOP:
        return 0
    return 2 if controller == "ppo" else 1


def rank(candidates: Sequence[Candidate]) -> Ranking:
    """Return the ranking of gaits."""
    pairs = len(candidates) * (len(candidates) - 1) // 2
    widths = [half_width(candidate, pairs) for candidate in candidates]

    def apart(i: int, j: int) -> float:
        scale = max(abs(candidates[i].thrust), abs(candidates[j].thrust))
        return max(math.hypot(widths[i], widths[j]), EXACT_TOLERANCE * scale)

    indices = not_excluded([candidate.thrust for candidate in candidates], apart)
    return Ranking(sort_by_simplicity(candidates[k] for k in indices))


def sort_by_simplicity(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Return the gaits, the simplest first, then by decreasing thrust."""
    return tuple(
        sorted(candidates, key=lambda candidate: (candidate.complexity, -candidate.thrust))
    )


def not_excluded(values: Sequence[float], apart: Callable[[int, int], float]) -> list[int]:
    """Return the indices of values that no other one exceeds by more than a half-width.

    apart: function that returns the half-width of the difference of the values of two indices
    """
    places = range(len(values))
    return [i for i in places if all(values[j] - values[i] <= apart(i, j) for j in places)]


def half_width(candidate: Candidate, comparisons: int) -> float:
    """Return the half-width for a number of simultaneous comparisons, at 95 % [N].

    The root of the sum of squares of two of them is the half-width of the difference, also for
    Student's t (Banerjee, "Approximate confidence interval for linear functions of means of k
    populations", Sankhyā 22 (1960) 357).
    """
    return candidate.ci95 * widening(comparisons, candidate.freedom)


def widening(comparisons: int, freedom: float = math.inf) -> float:
    """Return the factor by which simultaneous comparisons widen an interval."""
    return quantile(1.0 - 0.5 * LEVEL / max(1, comparisons), freedom) / student95(freedom)


def ratio(
    thrust: float, width: float, reference: float, reference_width: float
) -> tuple[float, float, float] | None:
    """Return a ratio of two thrusts with its interval, by Fieller's theorem; None if unbounded.

    (Fieller, "Some problems in interval estimation", J. R. Stat. Soc. B 16 (1954) 175.)
    width, reference_width: half-widths of independent intervals of the same level [N]
    """
    if not reference > reference_width:
        return None
    middle, scale = thrust * reference, reference**2 - reference_width**2
    half = math.sqrt(max(0.0, middle**2 - (thrust**2 - width**2) * scale))
    return thrust / reference, (middle - half) / scale, (middle + half) / scale


def format_choice(names: Sequence[str], chosen: str, reason: str) -> str:
    """Return "undecided between A, B and C; A is chosen because …"."""
    return f"undecided between {join(names)}; {chosen} is chosen because {reason}"


def join(names: Sequence[str]) -> str:
    """Return "A, B and C"."""
    *some, last = names
    return f"{', '.join(some)} and {last}" if some else last


def format_ratio(share: tuple[float, float, float]) -> str:
    """Return a ratio with its interval, in percent."""
    value, low, high = share
    return f"{percent(value)} [{percent(low)}, {percent(high)}]"


def percent(share: float) -> str:
    """Return a share in percent, with one decimal."""
    return f"{round(100.0 * share, 1) + 0.0:.1f} %"  # no negative zero
