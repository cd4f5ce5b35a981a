"""Ranking of gaits: those that may be the best, and the chosen one."""

import math

import numpy as np
import pytest

from fishd.lab.ranking import Candidate, complexity, rank, ratio, widening

WAVE, LAW, POLICY = map(complexity, ("square", "swing", "ppo"))


def test_where_intervals_overlap_the_simplest_gait_is_chosen_not_the_largest_mean() -> None:
    ranking = rank(
        [
            Candidate("policy", 20.4, 0.3, POLICY),
            Candidate("swing", 20.2, 0.3, LAW),
            Candidate("square", 20.1, 0.3, WAVE),
            Candidate("sine", 17.0, 0.3, WAVE),
        ]
    )
    assert [candidate.name for candidate in ranking.undecided] == ["square", "swing", "policy"]
    assert (ranking.chosen.name, ranking.reason) == ("square", "it is the simplest")
    assert not ranking.is_decided


def test_a_gait_is_excluded_by_any_other_not_by_the_largest_mean_alone() -> None:
    vague, sharp, low = ("vague", 26.0, 3.0), ("sharp", 25.0, 0.2), ("low", 23.5, 0.2)
    ranking = rank([Candidate(*candidate, WAVE) for candidate in (vague, sharp, low)])
    assert [candidate.name for candidate in ranking.undecided] == ["vague", "sharp"]


def test_thrusts_without_an_error_count_as_equal_up_to_rounding_alone() -> None:
    near = rank([Candidate("swing", 20.0001, 0.0, LAW), Candidate("square", 20.0, 0.0, WAVE)])
    assert near.chosen.name == "square"
    apart = rank([Candidate("swing", 20.01, 0.0, LAW), Candidate("square", 20.0, 0.0, WAVE)])
    assert (apart.is_decided, apart.chosen.name) == (True, "swing")


def test_intervals_from_few_runs_are_widened_by_students_t() -> None:
    # Quantiles 1 − 0.025/3 and 0.975, from tables of the normal and of t with two degrees.
    assert widening(3) == pytest.approx(2.394 / 1.960, rel=1e-3)
    assert widening(3, 2.0) == pytest.approx(7.649 / 4.303, rel=1e-3)
    assert widening(1, 2.0) == pytest.approx(1.0)


@pytest.mark.parametrize("freedom", [math.inf, 2])
def test_the_best_gait_is_left_out_in_no_more_than_five_percent_of_cases(freedom: float) -> None:
    generator = np.random.default_rng(7)
    true, sigma = np.array([20.0, 20.0, 19.9, 19.5]), np.array([0.3, 0.1, 0.2, 0.1])
    lost = 0
    for _ in range(1000):
        if math.isinf(freedom):
            means, ci95 = generator.normal(true, sigma), 1.96 * sigma
        else:
            runs = generator.normal(true, sigma, (3, 4))
            means, ci95 = runs.mean(axis=0), 4.303 * runs.std(axis=0, ddof=1) / math.sqrt(3.0)
        numbers = enumerate(zip(means, ci95, strict=True))
        candidates = [Candidate(str(k), *map(float, both), 0, freedom) for k, both in numbers]
        lost += "0" not in {candidate.name for candidate in rank(candidates).undecided}
    assert lost <= 50


def test_a_ratio_to_a_thrust_that_may_be_zero_has_no_interval() -> None:
    assert ratio(1.0, 0.1, 0.1, 0.2) is None
    assert ratio(2.0, 0.0, 1.0, 0.0) == (2.0, 2.0, 2.0)
