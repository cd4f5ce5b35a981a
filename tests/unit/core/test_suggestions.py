"""Suggestions for a wrong word: made on the ticking thread, so they cost next to nothing."""

import time
from collections.abc import Callable

import pytest

from fishd.config import Config, keys
from fishd.core.schema import MAX_SUGGESTION_CHARACTERS, Problem, convert, suggest

POLICIES = [f"policy-{number:04d}-swim" for number in range(500)]
KEYS = keys()


def measure_cost(function: Callable[[], object]) -> float:
    """Return the time of a function over that of a sum of 10 000 numbers, about 0.2 ms."""
    return fastest(function) / fastest(lambda: sum(range(10_000)))


def fastest(function: Callable[[], object]) -> float:
    """Return the shortest CPU time of a function in several runs [s]."""
    times = []
    for _ in range(5):
        start = time.thread_time()
        function()
        times.append(time.thread_time() - start)
    return min(times)


@pytest.mark.parametrize(
    ("word", "words", "limit"),
    [("status" * 10_000, ["status", "controllers"], 2), ("policy-0123-swum", POLICIES, 15)],
    ids=["64 kB", "500 names"],
)
def test_a_suggestion_is_quick(word: str, words: list[str], limit: int) -> None:
    assert measure_cost(lambda: suggest(word, words)) < limit


def test_the_nearest_of_many_is_found() -> None:
    assert suggest("policy-0123-swum", POLICIES) == "did you mean 'policy-0123-swim'?"
    assert suggest("servo.gpoi", KEYS) == "did you mean 'servo.gpio'?"
    for known in KEYS:
        swapped = known[:-2] + known[-1] + known[-2]
        assert suggest(swapped, KEYS).startswith("did you mean"), swapped


def test_a_word_that_is_too_long_to_be_meant_gets_no_suggestion() -> None:
    known = "x" * (MAX_SUGGESTION_CHARACTERS + 1)
    assert suggest(known + "y", [known]).startswith("valid: ")


@pytest.mark.parametrize("value", ["x" * 60_000, {"a": ["b"] * 20_000}, 10**4000])
def test_a_long_value_is_quoted_briefly_and_quickly(value: object) -> None:
    def refuse() -> str:
        with pytest.raises(Problem) as problem:
            convert({"tick": value}, Config)
        return str(problem.value)

    assert len(refuse()) < 150
    assert measure_cost(refuse) < 10
