"""The statistics: quantiles within 12 %, and the exact worst duration."""

import random

from hypothesis import given
from hypothesis import strategies as st

from fishd.control.statistics import PHASES, Histogram, Statistics


@given(st.lists(st.floats(1e-7, 100.0), min_size=1, max_size=300), st.floats(0.01, 1.0))
def test_a_quantile_is_at_most_an_eighth_too_large(durations: list[float], share: float) -> None:
    histogram = Histogram()
    for seq, duration in enumerate(durations):
        histogram.add(duration, seq)
    ordered = sorted(durations)
    true = next(d for n, d in enumerate(ordered, 1) if n >= share * len(ordered))
    quantile = histogram.quantile(share)
    assert true - 1e-9 <= quantile <= true * 1.126 + 1e-9


def test_the_worst_is_kept_exactly_with_its_tick() -> None:
    histogram = Histogram()
    generator = random.Random(1)
    for seq in range(1000):
        histogram.add(0.123456789 if seq == 321 else generator.uniform(0, 0.1), seq)
    assert histogram.percentiles().max == 0.123456789 * 1e6
    assert histogram.percentiles().max_seq == 321


def test_nothing_and_negative_and_endless_durations_are_no_problem() -> None:
    histogram = Histogram()
    assert histogram.percentiles().p99 == 0.0
    histogram.add(-1.0, 1)
    assert histogram.quantile(1.0) == 0.0
    histogram.add(1e9, 2)
    assert histogram.percentiles().max == 1e15


def test_each_phase_has_its_own_distribution() -> None:
    statistics = Statistics(period=0.05)
    statistics.add(1, 5e-6, 0, (0.0, 0.001, 0.003, 0.006, 0.010, 0.015))
    phases = statistics.timing().phases
    assert list(phases) == list(PHASES)
    worst = [round(phase.max) for phase in phases.values()]
    assert worst == [1000, 2000, 3000, 4000, 5000]
    assert round(statistics.timing().duration.max) == 15000
