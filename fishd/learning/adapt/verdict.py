"""The best gait according to the measurement, and its relative thrust."""

from collections.abc import Mapping, Sequence

import numpy as np

from fishd.lab.compare.comparison import Standing
from fishd.lab.ranking import (
    Candidate,
    complexity,
    format_choice,
    format_ratio,
    half_width,
    join,
    not_excluded,
    rank,
    ratio,
    widening,
)
from fishd.lab.statistics import Z95
from fishd.learning.adapt.prior import combine, deviations, is_rejected
from fishd.learning.adapt.results import SQUARE, Model, Verdict

NAMES = {
    "policy": "the policy",
    "swing": "swing",
    SQUARE: "the best square wave tried",
}


def judge(
    gaits: Sequence[Standing], model: Model, expected: Mapping[str, Sequence[float]]
) -> Verdict:
    """Return which gait is the best one, or between which gaits the measurement is undecided.

    A gait wins if it thrusts more than all others by more than the intervals of the differences
    (`fishd.lab.ranking`). Where several are left, those are dropped that the measurement and the
    identified fish together exclude, and the simplest of the rest is chosen.

    Thrusts are relative to that of the square wave. Their intervals hold together in 95 % of cases
    (Bonferroni). The relative thrust of the square wave itself is 1, without an error.

    There is none where the thrust of the square wave does not differ clearly from zero.

    gaits: measured gaits; one is named `square`
    expected: as `Adapted.expected_thrusts`
    """
    square = next(gait for gait in gaits if gait.contestant == SQUARE)
    others = [gait for gait in gaits if gait is not square]
    shares = {
        gait.contestant: share
        for gait in others
        if (share := _relative_thrust(gait, square, len(others)))
    }
    ranking = rank([_candidate(gait) for gait in gaits])
    names = [candidate.name for candidate in ranking.undecided]
    if ranking.is_decided:
        chosen, claim = names[0], _format_win(names[0], shares)
    else:
        left = _not_excluded_by(gaits, names, model, expected)
        chosen = left[0]
        reason = _explain_choice(ranking.reason, chosen == names[0], len(left), model)
        claim = format_choice([NAMES[name] for name in names], NAMES[chosen], reason)
        if shares:
            claim += f". Thrusts relative to {NAMES[SQUARE]}: {_format_shares(shares)}"
        if disuse := _explain_disuse(model):
            claim += f". {disuse[0].upper()}{disuse[1:]}"
    if len(shares) < len(others):
        claim += f". No relative thrust is known, as {NAMES[SQUARE]} hardly thrusts"
    known = 1.0 if chosen == SQUARE else None
    relative_thrust, low, high = shares.get(chosen, (known, known, known))
    return Verdict(
        chosen_gait=chosen,
        is_decided=ranking.is_decided,
        undecided_gaits=names,
        relative_thrust=relative_thrust,
        relative_thrust_ci95_low=low,
        relative_thrust_ci95_high=high,
        relative_thrusts=shares,
        claim=claim,
    )


def _candidate(gait: Standing) -> Candidate:
    return Candidate(
        gait.contestant, gait.thrust, gait.thrust_ci95 or 0.0, complexity(gait.controller)
    )


def _relative_thrust(
    gait: Standing, square: Standing, comparisons: int
) -> tuple[float, float, float] | None:
    """Return a relative thrust with its interval; None where that of the square is near zero."""
    widths = [half_width(_candidate(each), comparisons) for each in (gait, square)]
    return ratio(gait.thrust, widths[0], square.thrust, widths[1])


def _not_excluded_by(
    gaits: Sequence[Standing],
    names: list[str],
    model: Model,
    expected_thrusts: Mapping[str, Sequence[float]],
) -> list[str]:
    """Return the undecided gaits that the identified fish does not exclude, in their order."""
    if model.standard_error is None or model.is_rejected:
        return names
    expected = np.array([expected_thrusts.get(gait.contestant, ()) for gait in gaits]).T
    if not expected.size or expected[0].min() <= 0.0:
        return names
    places = range(len(gaits))
    measured = np.array([gait.thrust for gait in gaits])
    ci95 = np.array([gait.thrust_ci95 for gait in gaits])
    spread = deviations(expected, model.standard_error)
    if is_rejected(expected[0], spread, places, measured, ci95):
        return names
    thrusts, covariance = combine(expected[0], spread, places, measured, ci95)
    width = Z95 * widening(len(gaits) * (len(gaits) - 1) // 2)

    def apart(i: int, j: int) -> float:
        variance = covariance[i, i] + covariance[j, j] - 2.0 * covariance[i, j]
        return width * float(np.sqrt(max(0.0, variance)))

    left = {gaits[k].contestant for k in not_excluded(thrusts.tolist(), apart)}
    return [name for name in names if name in left] or names


def _explain_choice(simplest: str, is_simplest: bool, left: int, model: Model) -> str:
    """Return why a gait is chosen among those that the measurement leaves undecided.

    simplest: reason for the simplest one; left: number of gaits that the identified fish leaves
    """
    if is_simplest:
        return simplest
    fish = f"the identified fish, which explains {model.explained_fraction:.1%} of its forces"
    if left == 1:
        return f"{fish}, thrusts most with it"
    return f"it is the simplest that {fish}, leaves possible"


def _explain_disuse(model: Model) -> str:
    """Return why the identified fish is not used for a choice; empty where it is used."""
    if model.standard_error is None:
        explained = max(0.0, model.explained_fraction)
        return f"the fit, which explains {explained:.0%} of the forces, is not used for this"
    if model.is_rejected:
        return "the square waves tried disagree with the identified fish, so it is not used"
    return ""


def _format_win(name: str, shares: dict[str, tuple[float, float, float]]) -> str:
    if name in shares:
        return f"{NAMES[name]} wins: its thrust is {format_ratio(shares[name])} of {NAMES[SQUARE]}"
    if not shares:
        return f"{NAMES[name]} wins"
    return f"{NAMES[SQUARE]} wins. Thrusts relative to it: {_format_shares(shares)}"


def _format_shares(shares: dict[str, tuple[float, float, float]]) -> str:
    return join([f"{NAMES[name]} {format_ratio(share)}" for name, share in shares.items()])
