"""Selection of the best of several policies with few swims, each with an unknown error."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from fishd.learning.env.swims import Swim
from fishd.learning.train.candidates import MAX_CANDIDATES, Candidate, Candidates

BEST_THRUST = 0.025


def policy(steps: int) -> Candidate:
    return Candidate(steps=steps, updates=0, rollouts=0, parameters={})


def swum(share: float | None) -> Swim:
    """Return a swim with a share of the best thrust; None: it stalled."""
    thrust = None if share is None else share * BEST_THRUST
    return Swim(thrust, 1.67, 1.0, share is None, 3.5)


def swim(candidates: Candidates, most: int, share: Callable[[Candidate], float]) -> int:
    """Make the requested swims, at most `most`; return their number."""
    for count in range(most):
        candidate = candidates.next()
        if candidate is None:
            return count
        candidates.add_swim(candidate, swum(share(candidate)))
    return most


def test_the_newest_swims_first_and_a_single_one_only_once() -> None:
    candidates = Candidates(BEST_THRUST)
    assert candidates.next() is candidates.best is None
    first = policy(64)
    candidates.add(first)
    assert candidates.ci95(first) == math.inf
    assert swim(candidates, 10, lambda _: 0.9) == 1
    assert candidates.best is first
    second = policy(128)
    candidates.add(second)
    assert candidates.next() is second


def test_no_time_is_spent_where_the_best_is_clear() -> None:
    candidates = Candidates(BEST_THRUST)
    for steps in (64, 128):
        candidates.add(policy(steps))
    assert swim(candidates, 10, lambda candidate: {64: 0.5, 128: 0.9}[candidate.steps]) == 2
    candidates.remove_unlikely()
    assert [candidate.steps for candidate in candidates.remaining] == [128]


def test_a_lucky_swim_does_not_stay_the_best() -> None:
    candidates = Candidates(BEST_THRUST)
    steady, lucky = policy(64), policy(128)
    candidates.add(steady)
    for _ in range(3):
        candidates.add_swim(steady, swum(0.98))
    candidates.add(lucky)
    lucks = itertools.chain([1.02], itertools.repeat(0.94))
    swims = swim(candidates, 20, lambda candidate: next(lucks) if candidate is lucky else 0.98)
    assert swims < 15
    assert candidates.best is steady
    assert lucky.thrust < steady.thrust


def test_a_policy_that_swam_often_is_preferred_to_one_that_swam_as_well_once() -> None:
    candidates = Candidates(BEST_THRUST)
    often, once = policy(64), policy(128)
    for candidate in (often, once):
        candidates.add(candidate)
    for _ in range(5):
        candidates.add_swim(often, swum(0.98))
    candidates.add_swim(once, swum(0.985))
    assert candidates.best is often
    assert candidates.ci95(once) == pytest.approx(math.sqrt(5) * candidates.ci95(often))


def test_a_swim_with_too_many_lost_ticks_is_repeated() -> None:
    candidates = Candidates(BEST_THRUST)
    candidate = policy(64)
    candidates.add(candidate)
    candidates.add_swim(candidate, Swim(None, 1.67, 1.0, False, 3.5))
    assert candidates.best is None
    assert candidates.next() is candidate
    assert candidate.swim_time == 3.5


def test_the_number_of_remaining_candidates_is_limited() -> None:
    candidates = Candidates(BEST_THRUST)
    for steps in range(64, 64 * 40, 64):
        candidates.add(policy(steps))
        swim(candidates, 2, lambda _: 0.98)
        best = candidates.best
        candidates.remove_unlikely()
        assert candidates.best is best
        assert len(candidates.remaining) <= MAX_CANDIDATES + 1


@pytest.mark.parametrize("off", [0.005, 0.015, 0.03])
def test_intervals_contain_the_truth_and_the_best_is_close_to_the_true_best(off: float) -> None:
    draw = np.random.default_rng(5)
    truth: dict[int, float] = {}
    inside, shortfalls = [], []

    def measured(candidate: Candidate) -> float:
        return truth[candidate.steps] + draw.normal(0.0, off)

    for _ in range(100):
        candidates = Candidates(BEST_THRUST)
        truth |= {64 * n: float(draw.uniform(0.8, 1.0)) for n in range(1, 9)}
        policies = [policy(steps) for steps in truth]
        for newest in policies:
            candidates.add(newest)
            swim(candidates, 2, measured)
            candidates.remove_unlikely()
        for candidate in policies:
            inside.append(
                abs(candidate.thrust / BEST_THRUST - truth[candidate.steps])
                < candidates.ci95(candidate) / BEST_THRUST
            )
        best = candidates.best
        shortfalls.append(max(truth.values()) - truth[best.steps])
    assert np.mean(inside) >= 0.93
    assert np.mean(shortfalls) < 0.2 * off + 0.001
