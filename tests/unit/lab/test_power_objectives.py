"""Experiments on the power of a thrust: thrust per watt, and a thrust at the least power."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.processes import fishctl, one_line

from fishd.config import load
from fishd.core.errors import ParameterError
from fishd.lab.compare.comparison import compare
from fishd.lab.compare.live import LiveComparison
from fishd.lab.measurement import measure
from fishd.lab.optimise.least_power import LeastPower
from fishd.lab.optimise.search import Range
from fishd.lab.optimise.trials import Aim, Trial
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import simulate
from fishd.lab.statistics import per_watt

DRIFTING = load("config/simulated.yaml")
RANGE = Range("frequency", 0.5, 5.0)


def test_a_measurement_tells_power_and_thrust_per_watt_with_their_intervals() -> None:
    with VirtualSession(DRIFTING) as rig:
        report = measure(rig, "swing", {}, 40.0).summary()
    truth = simulate(DRIFTING, "swing", {})
    assert report.power == pytest.approx(truth.mean_power, rel=0.01)
    assert report.thrust_per_watt == pytest.approx(report.thrust / report.power)
    assert report.thrust_per_watt_ci95 is not None
    true_thrust_per_watt = truth.mean_thrust / truth.mean_power
    error = 2.0 * report.thrust_per_watt_ci95
    assert report.thrust_per_watt == pytest.approx(true_thrust_per_watt, abs=error)


@pytest.mark.slow
def test_without_a_power_meter_a_measurement_tells_the_thrust_alone() -> None:
    config = load("config/virtual-pi.yaml", ["sensors.power_meter=null"])
    with VirtualSession(config) as rig:
        report = measure(rig, "square", {"frequency": 2.0}, 20.5).summary()
    assert report.thrust > 0.0
    assert (report.power, report.power_ci95, report.thrust_per_watt) == (None, None, None)


def test_the_error_of_a_ratio_is_that_of_both() -> None:
    drawn = np.random.default_rng(1).normal((0.02, 0.5), (1e-3, 0.02), (20_000, 2))
    spread = 1.96 * np.std(drawn[:, 0] / drawn[:, 1])
    value, error = per_watt(0.02, 1.96e-3, 0.5, 1.96 * 0.02)
    assert (value, error) == (pytest.approx(0.04), pytest.approx(spread, rel=0.03))
    assert per_watt(0.02, 1e-3, None, None) == (None, None)


def test_the_search_of_the_least_power_ends_where_the_thrust_is_just_reached() -> None:
    search = LeastPower([RANGE], target=0.015)
    generator = np.random.default_rng(5)
    for _ in range(12):
        candidate = search.suggest()
        frequency = candidate["frequency"]
        thrust = 0.025 * math.exp(-(math.log(frequency / 1.7) ** 2) / 0.5)
        measured = thrust + generator.normal(0.0, 0.3e-3)
        search.observe(candidate, (measured, 0.6e-3), (0.1 + 0.3 * frequency, 1e-3))
    proposal = search.propose()
    slowest = 1.7 * math.exp(-math.sqrt(0.5 * math.log(0.025 / 0.015)))  # where it is 15 mN
    assert proposal.parameters["frequency"] == pytest.approx(slowest, rel=0.1)
    low, high = proposal.parameters_ci95_low, proposal.parameters_ci95_high
    assert low["frequency"] <= slowest <= high["frequency"]
    assert proposal.value == pytest.approx(0.1 + 0.3 * slowest, rel=0.1)


def test_a_thrust_that_nothing_reaches_leads_to_the_most_there_is() -> None:
    search = LeastPower([RANGE], target=0.05)
    for _ in range(10):
        candidate = search.suggest()
        thrust = 0.025 * math.exp(-(math.log(candidate["frequency"] / 1.7) ** 2) / 0.5)
        search.observe(candidate, (thrust, 0.3e-3), (0.5, 1e-3))
    assert search.propose().parameters["frequency"] == pytest.approx(1.7, rel=0.2)


@pytest.mark.parametrize("aim", [Aim("thrust-per-watt"), Aim("thrust", 0.015)])
def test_without_a_power_meter_there_is_no_search_of_a_power(aim: Aim) -> None:
    trial = Trial({"frequency": 1.0}, 0.02, 1e-3, math.nan, math.nan, 40, 10.0)
    with pytest.raises(ParameterError, match="no power meter that can be read"):
        aim.observe(aim.make_search([RANGE], 0), trial)


def _run_optimise(tmp_path: Path, *words: str) -> dict[str, Any]:
    done = fishctl(
        *("optimise", "square", "--frequency", "0.6:2", "--on", "simulation"),
        *("--folder", f"{tmp_path}/run", "--json", *words),
    )
    optimum: dict[str, Any] = json.loads(done.stdout)
    return optimum


@pytest.mark.slow
def test_optimise_finds_the_frequency_that_gives_most_for_each_watt(tmp_path: Path) -> None:
    optimum = _run_optimise(tmp_path, "--objective", "thrust-per-watt")
    swims = [simulate(load(None), "square", {"frequency": 0.5 / (0.05 * n)}) for n in range(5, 10)]
    best = max(swim.mean_thrust / swim.mean_power for swim in swims)
    assert optimum["true_thrust"] / optimum["true_power"] > 0.97 * best
    error = optimum["thrust_per_watt_ci95"]
    assert optimum["thrust_per_watt"] == pytest.approx(best, abs=2 * error)


@pytest.mark.slow
def test_optimise_finds_the_slowest_beat_that_gives_a_thrust(tmp_path: Path) -> None:
    optimum = _run_optimise(tmp_path, "--target-thrust", "15")
    assert (optimum["objective"], optimum["target"]) == ("least-power", 0.015)
    assert optimum["parameters"] == {"frequency": pytest.approx(1.0)}
    assert optimum["true_thrust"] > 0.015


def test_two_aims_are_one_too_many() -> None:
    done = fishctl(
        *("optimise", "square", "--frequency", ":", "--on", "simulation"),
        *("--objective", "thrust", "--target-thrust", "15"),
    )
    assert "exclude each other: give one of them" in one_line(done)


def test_a_comparison_tells_what_each_watt_gave_simulated_and_measured() -> None:
    calm = replace(DRIFTING, simulation=replace(DRIFTING.simulation, drift=0.0))
    entries = ["square:frequency=1.25", "square:frequency=2.5"]
    (slow, fast), _ = compare(calm, entries, 20.0, 5.0)
    assert slow.thrust_per_watt is not None
    assert fast.thrust_per_watt is not None
    assert slow.thrust_per_watt > fast.thrust_per_watt
    with VirtualSession(calm) as rig:
        live = LiveComparison(rig, entries)
        live.swim(25.0)
    for truth, measured in zip((slow, fast), live.standings(), strict=True):
        assert truth.thrust_per_watt is not None
        assert measured.thrust_per_watt_ci95 is not None
        error = 2.0 * measured.thrust_per_watt_ci95
        assert measured.thrust_per_watt == pytest.approx(truth.thrust_per_watt, abs=error)
