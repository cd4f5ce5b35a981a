"""Which of several gaits is the best one, as far as their intervals tell; for compare and adapt.

A gait is excluded where another one thrusts more than it by more than the interval of their
difference. The intervals of all pairs hold together in 95 % of cases (Bonferroni), whichever gait
is the best one. What is left is undecided, and the simplest gait is chosen from it.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from fishd.lab.statistics import quantile, student95

LEVEL = 0.05
"""Probability with which one of the intervals that belong together may fail."""
EXACT_TOLERANCE = 1e-4
"""Relative difference up to which two thrusts without an error count as equal."""
_OPEN_LOOP = frozenset(("hold", "square", "sine", "triangle", "excitation"))


class Candidate(NamedTuple):
    """A gait, and what was measured of it."""

    name: str
    thrust: float
    """[N]"""
    ci95: float
    """Half-width of its 95 % confidence interval, without calibration; 0 for an exact one [N]."""
    complexity: int
    """The smaller, the simpler: see `complexity`."""
    freedom: float = math.inf
    """Degrees of freedom of that interval, by Student's t."""


class Ranking(NamedTuple):
    """The gaits that may be the best one, and which of them is chosen."""

    undecided: tuple[Candidate, ...]
    """Those that none of the others excludes, simplest first; of equally simple ones, the one that
    thrusts most."""

    @property
    def is_decided(self) -> bool:
        """Return True where the measurement alone says which one is the best."""
        return len(self.undecided) == 1

    @property
    def chosen(self) -> Candidate:
        """The simplest one."""
        return self.undecided[0]

    @property
    def reason(self) -> str:
        """Why that one is chosen, as a clause."""
        alike = [each for each in self.undecided if each.complexity == self.chosen.complexity]
        if len(alike) == 1:
            return "it is the simplest"
        if len(alike) < len(self.undecided):
            return "it thrusts most of the simplest ones"
        return "all are equally simple, and it thrusts most"


def complexity(controller: str) -> int:
    """Return 0 for a given wave, 1 for a law that looks at the forces, 2 for a policy."""
    if controller in _OPEN_LOOP:
        return 0
    return 2 if controller == "ppo" else 1


def rank(candidates: Sequence[Candidate]) -> Ranking:
    """Return which of these may be the best one."""
    pairs = len(candidates) * (len(candidates) - 1) // 2
    widths = [half_width(each, pairs) for each in candidates]

    def apart(i: int, j: int) -> float:
        scale = max(abs(candidates[i].thrust), abs(candidates[j].thrust))
        return max(math.hypot(widths[i], widths[j]), EXACT_TOLERANCE * scale)

    left = not_excluded([each.thrust for each in candidates], apart)
    return Ranking(in_order(candidates[k] for k in left))


def in_order(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Return them simplest first; of equally simple ones, the one that thrusts most first."""
    return tuple(sorted(candidates, key=lambda each: (each.complexity, -each.thrust)))


def not_excluded(values: Sequence[float], apart: Callable[[int, int], float]) -> list[int]:
    """Return which values no other one exceeds by more than the interval of their difference.

    apart: half-width of the interval of the difference of two of them
    """
    places = range(len(values))
    return [i for i in places if all(values[j] - values[i] <= apart(i, j) for j in places)]


def half_width(candidate: Candidate, comparisons: int) -> float:
    """Return the half-width that holds in so many comparisons together, in 95 % of cases [N].

    The square root of the sum of squares of two such is a half-width of a difference, also for
    Student's t (Banerjee, "Approximate confidence interval for linear functions of means of k
    populations", Sankhyā 22 (1960) 357).
    """
    return candidate.ci95 * widening(comparisons, candidate.freedom)


def widening(comparisons: int, freedom: float = math.inf) -> float:
    """Return how much wider an interval is that holds in so many comparisons together."""
    return quantile(1.0 - 0.5 * LEVEL / max(1, comparisons), freedom) / student95(freedom)


def ratio(
    thrust: float, width: float, reference: float, reference_width: float
) -> tuple[float, float, float] | None:
    """Return a ratio of two thrusts with its interval, by Fieller's theorem; None if unbounded.

    (Fieller, "Some problems in interval estimation", J. R. Stat. Soc. B 16 (1954) 175.)
    width, reference_width: half-widths of independent intervals of the wanted level [N]
    """
    if not reference > reference_width:
        return None
    middle, scale = thrust * reference, reference**2 - reference_width**2
    half = math.sqrt(max(0.0, middle**2 - (thrust**2 - width**2) * scale))
    return thrust / reference, (middle - half) / scale, (middle + half) / scale


def format_choice(names: Sequence[str], chosen: str, reason: str) -> str:
    """Return "undecided between A, B and C; A chosen because …"."""
    return f"undecided between {join(names)}; {chosen} chosen because {reason}"


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
