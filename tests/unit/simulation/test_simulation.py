"""Runs in virtual time: repeatable to the last bit, with figures from the true plant."""

import json
import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rigs.documents import ROOT
from rigs.harness import PINNED_TICK
from rigs.processes import fishctl, one_line

from fishd.assembly import simulated_fish
from fishd.config import load
from fishd.core.errors import ConfigError, ParameterError
from fishd.lab import simulation
from fishd.lab.simulation import Beats, simulate
from fishd.virtual.imperfections import Imperfections
from fishd.virtual.plant.base import TrueWindow
from fishd.virtual.plant.optimum import square_wave


@pytest.mark.parametrize("start", [0.0, 12_345.67])
def test_the_same_seed_drifts_in_the_same_way_whenever_it_starts(start: float) -> None:
    config = load(
        None, [PINNED_TICK, "simulation.drift=0.02", "simulation.noise=0", "simulation.seed=3"]
    )
    fish = simulated_fish(config)
    forces = [fish.read(start + 0.05 * n).fx for n in range(1, 200)]
    drift = Imperfections(config.simulation, config.tick)
    wanted = [drift.apply(0.0, 0.0, 0.05 * n, 0.05)[0] for n in range(1, 200)]
    assert forces == pytest.approx(wanted, abs=1e-9)


def test_figures_are_those_of_the_plant_and_not_of_the_sensor() -> None:
    config = load(None, [PINNED_TICK, "simulation.offset_x=0.5", "simulation.noise=0"])
    report = simulate(config, "square", {"frequency": 2.0})
    truth = square_wave(config.plant, 0.42, 2.0)
    assert report.mean_thrust == pytest.approx(truth.thrust, rel=1e-6)
    assert report.fin_amplitude == pytest.approx(truth.fin_amplitude, rel=1e-4)
    assert report.frequency == pytest.approx(2.0)


def test_on_the_grid_the_best_square_wave_comes_close_to_the_optimum() -> None:
    report = simulate(load(), "square", {"frequency": 1.7089})
    assert 0.98 <= report.relative_thrust <= 1.0
    assert report.best_square_frequency == pytest.approx(1.7089, abs=0.005)
    assert report.best_square_thrust == pytest.approx(25.78384e-3, rel=1e-4)


def test_a_fish_that_does_not_beat_has_no_frequency_and_no_thrust() -> None:
    report = simulate(load(), "hold", {"angle": 0.3}, 30)
    assert (report.frequency, report.mean_thrust) == (0.0, pytest.approx(0.0, abs=1e-9))
    assert report.fin_amplitude == pytest.approx(0.3 * 0.46, rel=1e-3)
    neutral = simulate(load(), "hold", {}, 20)
    assert (neutral.fullness, neutral.form_factor) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("seconds", "settle", "why"),
    [
        (math.nan, 1, r"a number from 0 to 1e\+08 s is needed"),
        (9, -1, r"a number from 0 to 1e\+08 s is needed"),
        (5, 10, "a run of 5 s is too short"),
    ],
)
def test_a_length_that_leaves_nothing_is_refused(seconds: float, settle: float, why: str) -> None:
    with pytest.raises(ParameterError, match=why):
        simulate(load(), "swing", {}, seconds, settle)


def test_slack_that_swallows_the_whole_amplitude_leaves_nothing_to_compare_with() -> None:
    report = simulate(load(None, [PINNED_TICK, "plant.cable_slack=0.5"]), "square", {}, 20)
    assert (report.mean_thrust, report.relative_thrust) == (0.0, 0.0)


@pytest.mark.parametrize("tick", [0.002, 0.2])
def test_the_loop_runs_at_any_tick(tick: float) -> None:
    report = simulate(load(None, [f"tick={tick}"]), "square", {"frequency": 1.25}, 12, settle=5)
    expected = square_wave(load().plant, 0.42, 1.25).thrust
    assert report.mean_thrust == pytest.approx(expected, rel=1e-3)


def test_only_whole_beats_are_counted() -> None:
    beats = Beats()
    beats.add(1.0, TrueWindow(0.5, 9.0, 0.9))
    assert math.isnan(beats.means().thrust_deviation)  # needs two beats
    for angle, thrust in [(1.0, 9.0)] * 2 + [(-1.0, 1.0), (1.0, 2.0)] * 4 + [(-1.0, 9.0)]:
        beats.add(angle, TrueWindow(0.5, thrust, 0.1 * thrust))
    means = beats.means()
    assert means[:3] == pytest.approx((1.5, 1.0, 0.15))
    assert (beats.count, means.thrust_deviation) == (3, 0.0)
    for thrust in (3.0, 2.0, 1.0, 2.0):  # beats of other thrust
        beats.add(1.0, TrueWindow(0.5, thrust, 0.1))
        beats.add(-1.0, TrueWindow(0.5, 1.0, 0.1))
    assert beats.means().thrust_deviation > 0.0


run = partial(fishctl, "simulate")


def test_the_command_prints_json_with_the_documented_keys() -> None:
    done = run("swing", "--C", "0.6", "--seconds", "20", "--json", "--set", "simulation.noise=1e-3")
    report = json.loads(done.stdout)
    documented = "mean_thrust frequency fin_amplitude relative_thrust best_square_thrust ticks"
    assert {*documented.split(), "best_square_frequency", "real_time_factor"} <= set(report)
    assert report["ticks"] == 400
    assert report["relative_thrust"] > 0.97


@pytest.mark.parametrize(
    ("arguments", "message", "status"),
    [
        (["swim"], "fishctl: no controller is named 'swim'; did you mean 'swing'?\n", 1),
        (["swing", "--C", "inf"], "'inf' is not valid: a number in [0, 1] (or auto) is needed", 2),
        (["swing", "--set", "tick=3"], "fishctl: --set tick=3: tick: 3 is not valid", 78),
        (["swing", "--seconds", "1"], "fishctl: a run of 1 s is too short", 1),
        (["swing", "--seconds", "12", "--settle", "11.5"], "no whole tail beat in the 0.5 s", 1),
        (["swing", "--config", "no.yaml"], "fishctl: no.yaml: no such file", 78),
        (["remote", "--agent", "tcp://*:9"], "remote: agent: 'tcp://*:9' is not valid: ", 1),
    ],
)
def test_a_wrong_command_gets_one_line(arguments: list[str], message: str, status: int) -> None:
    done = run(*arguments)
    assert message in one_line(done)
    assert done.returncode == status


@pytest.mark.parametrize(
    ("arguments", "warning"),
    [
        (["thrust", "--target", "5"], "5 N is 194 times the best thrust known: .* 25.8 mN .*mN?"),
        (["swing", "--longest-half-period", "8"], "8 s is more than makes sense: .* (ms? that"),
        (["thrust", "--target", "0.02"], ""),
    ],
)
def test_a_value_beyond_what_makes_sense_is_warned_of(arguments: list[str], warning: str) -> None:
    done = run(*arguments, "--seconds", "8", "--settle", "5")
    assert done.returncode == 0
    if warning:
        assert re.search(warning.replace("?", r"\?").replace("(", r"\("), done.stderr)
        assert done.stderr.count("\n") == 1
    else:
        assert "target=0.02 N C=0.6 amplitude=default longest_half_period=1 s" in done.stdout
        assert not done.stderr


def test_the_heading_says_that_another_controller_swam(tmp_path: Path) -> None:
    from rigs.policy_files import write  # which needs the extra 'policy'

    shaking = write(tmp_path)
    policy = ("ppo", "--policy", str(shaking))
    heading = run(*policy).stdout.splitlines()[0]
    assert re.fullmatch(
        rf"controller +ppo policy={re.escape(str(shaking))} until \d\.\d\d s, then swing; "
        "whose figures these are",
        heading,
    )
    first = run(*policy, "--settle", "0").stdout.splitlines()[0]
    assert first.endswith("; the figures are of both")


def test_a_run_is_a_table_with_a_row_a_tick_and_the_same_numbers_as_a_report() -> None:
    table = simulation.run(None, "square", {"frequency": 1.7}, 40.0)
    assert list(table["seq"]) == list(range(1, 801))
    assert set(table["phi_c"]) == {-0.42, 0.42}
    assert "quantities.phase" in table
    report = simulate(load(None, [PINNED_TICK]), "square", {"frequency": 1.7}, 40.0)
    assert table["fx"][300:].mean() == pytest.approx(report.mean_thrust, rel=0.01)


def test_a_run_takes_a_path_or_a_configuration_and_keys_that_override_either() -> None:
    path = str(ROOT / "config" / "simulated.yaml")
    changes = {"tick": 0.02, "simulation.noise": np.float64(0.0)}
    fish = (path, load(path))
    of_file, of_config = (simulation.run(x, "swing", {}, 1.0, overrides=changes) for x in fish)
    assert of_file.equals(of_config)
    assert len(of_file) == 50
    assert not of_file.equals(simulation.run(path, "swing", {}, 1.0, overrides={"tick": 0.02}))
    for config in (path, load(path)):
        with pytest.raises(ConfigError, match=r"plant\.omega: unknown key; did you mean 'omega0'"):
            simulation.run(config, overrides={"plant.omega": 9})
