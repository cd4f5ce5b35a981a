"""Points of a sweep, and the maxima of its curves."""

import csv

import numpy as np
import pytest
from rigs.documents import ROOT

from fishd.core.errors import ParameterError
from fishd.lab.sweep.curves import find_peak
from fishd.lab.sweep.grid import Point, expand_values, find_axis, make_points, parse_value


def test_a_range_has_both_ends_and_decimals_that_are_exact() -> None:
    assert list(map(float, expand_values("0.4:1.2:0.2"))) == [0.4, 0.6, 0.8, 1.0, 1.2]
    values = expand_values("100:300:100,0.05, 1e-3")
    assert list(map(float, values)) == [100.0, 200.0, 300.0, 0.05, 0.001]


def test_a_value_is_a_number_where_it_is_one() -> None:
    texts = ["0.6", "1.0", "1E+1", "3", "on", "nan", "inf", "pi/servo", "1e400"]
    assert [*map(parse_value, texts)] == [0.6, 1, 10, 3, "on", "nan", "inf", "pi/servo", "1e400"]
    assert isinstance(parse_value("3"), int)  # as needed for a seed
    points = [Point("swing", {}, {"plant.xi": parse_value(x)}) for x in ("0.9", "1")]
    assert find_axis(points) == "plant.xi"


@pytest.mark.parametrize(
    "text", ["1:2", "2:1:0.1", "1:2:0", "a:b:c", "1:inf:1", "1,,2", "0:1:1e-9"]
)
def test_what_is_no_range_says_what_is_needed(text: str) -> None:
    with pytest.raises(ParameterError, match=r"LOW:HIGH:STEP|missing|more than"):
        expand_values(text)


def test_a_grid_has_every_combination_and_each_controller_only_its_own_parameters() -> None:
    takes = {"square": ["frequency", "amplitude"], "swing": ["C", "amplitude"]}
    values = {"frequency": [1.0, 2.0], "C": [0.6], "amplitude": [0.3]}
    grid = make_points(["square", "swing"], values, takes, {"plant.xi": ["0.6", "1.2"]})
    assert len(grid) == 6
    assert grid[-1] == Point("swing", {"C": 0.6, "amplitude": 0.3}, {"plant.xi": "1.2"})
    assert find_axis(grid) == "parameters.frequency"
    with pytest.raises(ParameterError, match=r"^square has no parameter 'phase'$"):
        make_points(["square"], {"phase": [0.1]}, takes)
    with pytest.raises(ParameterError, match=r"^none of square, swing has a parameter 'phase'$"):
        make_points(["square", "swing"], {"phase": [0.1]}, takes)


def test_the_best_of_a_noisy_curve_is_within_its_interval_as_often_as_it_says() -> None:
    generator = np.random.default_rng(1)
    x = np.arange(1.2, 2.25, 0.1)
    hits = 0
    for _ in range(300):
        truth = generator.uniform(1.5, 1.9)
        y = 25e-3 - 20e-3 * (x - truth) ** 2 + generator.normal(0.0, 0.3e-3, len(x))
        peak = find_peak(x.tolist(), y.tolist(), [0.6e-3] * len(x))
        assert peak.x_ci95_low is not None
        assert peak.x_ci95_high is not None
        hits += peak.x_ci95_low <= truth <= peak.x_ci95_high
    assert 0.92 <= hits / 300 <= 0.99


@pytest.mark.parametrize(("waveform", "frequency"), [("square", 1.709), ("sine", 1.752)])
def test_the_best_is_that_of_the_curve_and_not_of_the_grid(waveform: str, frequency: float) -> None:
    with (ROOT / "tests/reference/thrust_vs_frequency.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["waveform"] == waveform]
    x = [float(row["frequency_Hz"]) for row in rows]
    peak = find_peak(x, [float(row["mean_thrust_mN"]) for row in rows], [None] * len(x))
    assert peak.x == pytest.approx(frequency, abs=0.02)
    assert peak.x_ci95_low is not None
    assert peak.x_ci95_high is not None
    assert peak.x_ci95_low <= frequency <= peak.x_ci95_high


def test_a_best_at_the_edge_is_told_and_has_no_interval() -> None:
    peak = find_peak([1.0, 1.2, 1.4], [1.0, 2.0, 3.0], [0.1, 0.1, 0.1])
    assert (peak.x, peak.at_edge, peak.x_ci95_low) == (1.4, True, None)
