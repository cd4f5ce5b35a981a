"""The choice among measured gaits that the comparison leaves undecided, by the identified fish."""

from collections.abc import Mapping, Sequence

import numpy as np

from fishd.lab.compare.comparison import Standing, Verdict, judge_standings
from fishd.lab.ranking import format_choice, not_excluded, widening
from fishd.lab.statistics import Z95
from fishd.learning.adapt.prior import combine, deviations, is_rejected
from fishd.learning.adapt.results import Model


def judge(
    gaits: Sequence[Standing], model: Model, expected: Mapping[str, Sequence[float]]
) -> Verdict:
    """Return which gait is the best one, or between which gaits the measurement is undecided.

    That is the verdict of `fishctl compare`. Where several gaits are left, those are dropped that
    the measurement and the identified fish together exclude, and the simplest of the rest is
    chosen.

    gaits: two or more measured gaits
    expected: as `Adapted.expected_thrusts`
    """
    verdict = judge_standings(gaits)
    assert verdict
    if len(verdict.best) == 1:
        return verdict
    if disuse := _explain_disuse(model):
        return verdict._replace(sentence=f"{verdict.sentence}; {disuse}")
    left = _not_excluded_by(gaits, verdict.best, model, expected)
    if left[0] == verdict.best[0]:
        return verdict
    fish = f"the identified fish, which explains {model.explained_fraction:.1%} of its forces"
    reason = f"it is the simplest that {fish}, leaves possible"
    if len(left) == 1:
        reason = f"{fish}, thrusts most with it"
    names = (left[0], *(name for name in verdict.best if name != left[0]))
    return Verdict(format_choice(verdict.best, left[0], reason), names)


def _not_excluded_by(
    gaits: Sequence[Standing],
    names: Sequence[str],
    model: Model,
    expected_thrusts: Mapping[str, Sequence[float]],
) -> Sequence[str]:
    """Return the undecided gaits that the identified fish does not exclude, in their order."""
    expected = np.array([expected_thrusts.get(gait.contestant, ()) for gait in gaits]).T
    if model.standard_error is None or not expected.size or expected[0].min() <= 0.0:
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


def _explain_disuse(model: Model) -> str:
    """Return why the identified fish is not used for a choice; empty where it is used."""
    if model.standard_error is None:
        explained = max(0.0, model.explained_fraction)
        return f"the fit, which explains {explained:.0%} of the forces, is not used for this"
    if model.is_rejected:
        return "the square waves tried disagree with the identified fish, so it is not used"
    return ""
