"""`excitation`: a swept square wave of two amplitudes."""

from itertools import groupby, pairwise

import pytest
from msgspec.structs import replace
from rigs.harness import LIMITS, commands, observe

from fishd.controllers import registry
from fishd.core.errors import ParameterError


def test_it_sweeps_there_and_back_in_groups_of_beats_of_two_amplitudes() -> None:
    given = commands(registry.create("excitation", {}, LIMITS), 400)
    assert sorted({abs(angle) for angle in given}) == pytest.approx([0.168, 0.42])
    halves = [(angle, len(list(same))) for angle, same in groupby(given)]
    assert halves[0] == (0.42, pytest.approx(20, abs=3))
    assert min(length for _, length in halves) in (3, 4)  # 3 Hz
    groups = [len(list(same)) for _, same in groupby(abs(angle) for angle, _ in halves)]
    assert set(groups[:-1]) == {8}


def test_it_begins_on_the_side_where_the_tail_is() -> None:
    assert commands(registry.create("excitation", {}, LIMITS), 1, angle=-0.1) == [-0.42]


def test_a_sweep_that_goes_down_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"highest_frequency: 0\.3 Hz is below lowest_freq"):
        registry.create("excitation", {"highest_frequency": 0.3}, LIMITS)


def test_no_sweep_goes_beyond_two_ticks_a_beat() -> None:
    limits = replace(LIMITS, tick=0.2)
    controller = registry.create(
        "excitation", {"lowest_frequency": 2.4, "highest_frequency": 10.0}, limits
    )
    controller.activate(observe())
    sides = [controller.update(observe(dt=0.2)) > 0.0 for _ in range(200)]
    assert sum(a != b for a, b in pairwise(sides)) > 190
    with pytest.raises(
        ParameterError, match=r"lowest_frequency: 3 Hz is too fast for .* at most 2\.5 Hz"
    ):
        registry.create("excitation", {"lowest_frequency": 3.0}, limits)
