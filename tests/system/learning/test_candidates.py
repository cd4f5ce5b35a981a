"""The best of several policies is found with few swims, each of which has an unknown error."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from fishd.learning.env.swims import Swim
from fishd.learning.train.candidates import MAX_CANDIDATES, Candidate, Candidates

BEST = 0.025


def policy(steps: int) -> Candidate:
    return Candidate(steps=steps, updates=0, rollouts=0, parameters={})


def swum(share: float | None) -> Swim:
    """With this share of the best thrust; None: it stalled."""
    thrust = None if share is None else share * BEST
    return Swim(thrust, 1.67, 1.0, share is None, 3.5)


def swim(candidates: Candidates, most: int, share: Callable[[Candidate], float]) -> int:
    """Let those swim that are to, so often at most; how often they did."""
    for count in range(most):
        one = candidates.next()
        if one is None:
            return count
        candidates.count(one, swum(share(one)))
    return most


def test_the_newest_swims_first_and_one_alone_only_once() -> None:
    candidates = Candidates(BEST)
    assert candidates.next() is candidates.best is None
    first = policy(64)
    candidates.add(first)
    assert candidates.error(first) == math.inf
    assert swim(candidates, 10, lambda _: 0.9) == 1
    assert candidates.best is first
    second = policy(128)
    candidates.add(second)
    assert candidates.next() is second


def test_where_it_is_clear_no_time_is_spent_on_the_rest() -> None:
    candidates = Candidates(BEST)
    for steps in (64, 128):
        candidates.add(policy(steps))
    assert swim(candidates, 10, lambda one: {64: 0.5, 128: 0.9}[one.steps]) == 2
    candidates.remove_unlikely()
    assert [one.steps for one in candidates.remaining] == [128]


def test_a_lucky_swim_does_not_stay_the_best() -> None:
    candidates = Candidates(BEST)
    steady, lucky = policy(64), policy(128)
    candidates.add(steady)
    for _ in range(3):
        candidates.count(steady, swum(0.98))
    candidates.add(lucky)
    lucks = itertools.chain([1.02], itertools.repeat(0.94))
    swims = swim(candidates, 20, lambda one: next(lucks) if one is lucky else 0.98)
    assert swims < 15
    assert candidates.best is steady
    assert lucky.thrust < steady.thrust


def test_what_has_swum_once_is_promised_less_than_what_has_swum_as_well_often() -> None:
    candidates = Candidates(BEST)
    often, once = policy(64), policy(128)
    for one in (often, once):
        candidates.add(one)
    for _ in range(5):
        candidates.count(often, swum(0.98))
    candidates.count(once, swum(0.985))
    assert candidates.best is often
    assert candidates.error(once) == pytest.approx(math.sqrt(5) * candidates.error(often))


def test_one_that_stalls_is_out_also_if_it_was_the_best() -> None:
    candidates = Candidates(BEST)
    first, second = policy(64), policy(128)
    for one, share in ((first, 0.9), (second, 0.95)):
        candidates.add(one)
        candidates.count(one, swum(share))
    assert candidates.best is second
    candidates.count(second, swum(None))
    assert second.stalled
    assert candidates.best is first


def test_a_swim_of_which_too_much_was_lost_is_done_again() -> None:
    candidates = Candidates(BEST)
    one = policy(64)
    candidates.add(one)
    candidates.count(one, Swim(None, 1.67, 1.0, False, 3.5))
    assert candidates.best is None
    assert candidates.next() is one
    assert one.swam == 3.5


def test_no_more_are_kept_than_can_be_told_apart() -> None:
    candidates = Candidates(BEST)
    for steps in range(64, 64 * 40, 64):
        candidates.add(policy(steps))
        swim(candidates, 2, lambda _: 0.98)
        best = candidates.best
        candidates.remove_unlikely()
        assert candidates.best is best
        assert len(candidates.remaining) <= MAX_CANDIDATES + 1


@pytest.mark.parametrize("off", [0.005, 0.015, 0.03])
def test_intervals_hold_the_truth_and_the_best_is_hardly_below_the_true_best(off: float) -> None:
    draw = np.random.default_rng(5)
    truth: dict[int, float] = {}
    held, short = [], []

    def measured(one: Candidate) -> float:
        return truth[one.steps] + draw.normal(0.0, off)

    for _ in range(100):
        candidates = Candidates(BEST)
        truth |= {64 * n: float(draw.uniform(0.8, 1.0)) for n in range(1, 9)}
        those = [policy(steps) for steps in truth]
        for newest in those:
            candidates.add(newest)
            swim(candidates, 2, measured)
            candidates.remove_unlikely()
        for one in those:
            held.append(abs(one.thrust / BEST - truth[one.steps]) < candidates.error(one) / BEST)
        best = candidates.best
        assert best
        short.append(max(truth.values()) - truth[best.steps])
    assert np.mean(held) >= 0.93
    assert np.mean(short) < 0.2 * off + 0.001
