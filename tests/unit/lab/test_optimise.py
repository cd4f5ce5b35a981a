"""Search of the best parameters: few ticks of swimming, and intervals that hold."""

import json
import os
import re
import signal
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rigs.processes import fishctl, one_line

from fishd.config import load
from fishd.lab.experiment import find_answer
from fishd.lab.optimise.choice import Choice
from fishd.lab.optimise.search import Range, Search
from fishd.lab.optimise.trials import (
    Aim,
    Trial,
    measure_trials,
    restrict_to_whole_ticks,
    trial_durations,
)
from fishd.lab.rerun import rerun
from fishd.lab.session import VirtualSession
from fishd.lab.simulation import VirtualRun, simulate
from fishd.recording import open_run, read
from fishd.virtual.plant.base import TrueWindow

BEST = 25.736e-3
"""Best thrust of the default fish by a square wave of whole ticks, at 1.667 Hz [N]."""


@pytest.mark.slow
def test_a_few_noisy_measurements_find_a_maximum_and_say_how_well() -> None:
    generator = np.random.default_rng(3)
    search = Search([Range("frequency", 0.5, 5.0), Range("amplitude", 0.1, 0.4)], seed=1)
    for _ in range(11):
        candidate = search.suggest()
        thrust = 0.02 * np.exp(-4.0 * np.log(candidate["frequency"] / 1.7) ** 2)
        thrust *= 1.0 - 20.0 * (candidate["amplitude"] - 0.3) ** 2
        search.observe(candidate, thrust + generator.normal(0.0, 0.3e-3), 0.6e-3)
    best = search.propose()
    assert best.parameters == pytest.approx({"frequency": 1.7, "amplitude": 0.3}, rel=0.15)
    for name, truth in (("frequency", 1.7), ("amplitude", 0.3)):
        assert best.parameters_ci95_low[name] <= truth <= best.parameters_ci95_high[name]
    assert best.value == pytest.approx(0.02, abs=2.0 * best.value_ci95)


def test_what_is_proposed_is_a_frequency_of_whole_ticks_as_it_is_measured() -> None:
    search = Search([restrict_to_whole_ticks(Range("frequency", 1.2, 2.6), 0.05)])
    possible = (1.25, 10 / 7, 10 / 6, 2.0, 2.5)
    assert search.ranges[0].values == pytest.approx(possible)
    tried = set()
    for _ in range(8):
        frequency = search.suggest()["frequency"]
        tried.add(frequency)
        thrust = 0.0257 - 0.02 * (frequency - 1.74) ** 2  # its maximum is at none of them
        search.observe({"frequency": frequency}, thrust, 0.8e-3)
        best = search.propose()
        for parameters in (best.parameters, best.parameters_ci95_low, best.parameters_ci95_high):
            assert parameters["frequency"] in search.ranges[0].values
    assert best.parameters["frequency"] in tried
    assert best.parameters["frequency"] == pytest.approx(10 / 6)
    assert len(tried) > 3


@pytest.mark.slow
def test_a_search_on_a_rig_that_drifts_ends_by_itself_near_the_best() -> None:
    config = load("config/simulated.yaml")
    search = Search([restrict_to_whole_ticks(Range("frequency", 0.4, 5.0), config.tick)], seed=1)
    choice = Choice(search, Aim(), {}, 0.01)
    with VirtualSession(config) as rig:
        for trial in measure_trials(rig, "square", {}, choice.next, 300.0):
            choice.add(trial)
    assert trial.tank_time < 100.0
    assert choice.final == trial
    truth = simulate(config, "square", trial.parameters).mean_thrust
    assert truth >= 0.97 * BEST
    assert trial.thrust == pytest.approx(truth, abs=2.0 * trial.thrust_ci95)


@pytest.mark.parametrize("thrusts", [(7.60, 7.87, 7.73, 7.53), (20.0, 20.1, 19.9, 20.0)])
def test_a_few_thrusts_that_are_equal_by_chance_do_not_end_a_search(
    thrusts: tuple[float, ...],
) -> None:
    search = Search([Range("C", 0.05, 0.95)])
    for thrust in thrusts:
        search.observe(search.suggest(), thrust * 1e-3, 1.6e-3)
    proposal = search.propose()
    assert proposal.value_ci95 > 1e-3
    assert proposal.improvement > 0.01


def test_the_best_is_swum_last_and_its_neighbours_before() -> None:
    search = Search([restrict_to_whole_ticks(Range("frequency", 0.4, 5.0), 0.05)])
    choice, frequencies = Choice(search, Aim(), {}, 0.01), []
    while candidate := choice.next(300.0):
        frequency = candidate.parameters["frequency"]
        frequencies.append(frequency)
        thrust = 0.0257 - 0.02 * (frequency - 1.74) ** 2
        time = 7.0 * len(frequencies)
        choice.add(
            Trial(candidate.parameters, thrust, 1e-4, 0.6, 0.01, 90, time, 0.6, candidate.is_final)
        )
    assert choice.final
    assert frequencies[-1] == pytest.approx(10 / 6)
    assert {round(frequency, 3) for frequency in frequencies} >= {1.429, 1.667, 2.0}
    assert choice.next(300.0) is None


def test_without_time_for_more_the_best_so_far_is_swum() -> None:
    search = Search([Range("C", 0.05, 0.95)])
    choice = Choice(search, Aim(), {}, 0.0)
    for _ in range(3):
        candidate = choice.next(300.0)
        assert candidate
        assert not candidate.is_final
        trial = Trial(candidate.parameters, 0.02, 1e-3, 0.6, 0.01, 90, 7.0, 0.6, 0.0)
        choice.add(trial)
    last = choice.next(22.0)
    assert last
    assert last.is_final
    choice.add(trial._replace(parameters=last.parameters, is_final=1.0))
    assert choice.next(2.0) is None


def test_a_slow_beat_is_settled_and_measured_for_three_beats() -> None:
    assert trial_durations({"frequency": 0.5}) == (2.0, 8.0)
    assert trial_durations({}, beat=1.6) == pytest.approx((1.6, 6.4))


@pytest.mark.slow
def test_a_search_is_a_table_a_recording_and_a_picture(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = ["optimise", "square", "--frequency", "1:3"]
    done = fishctl(*words, "--folder", str(folder), "--budget", "22")
    assert done.returncode == 1
    assert "the budget of 22 s is used" in done.stderr
    assert "true thrust there" in done.stdout
    rows = (folder / "rows.csv").read_text().splitlines()
    assert rows[0] == (
        "frequency,thrust,thrust_ci95,power,power_ci95,swim_ticks,tank_time,beat,is_final"
    )
    passed = float(rows[-1].split(",")[6])
    run = open_run(folder / "optimise.mcap")
    assert len(run.ticks) == round(passed / 0.05)
    again = rerun(run).stretches
    assert len(again) == len(rows) - 1
    assert all(stretch.from_start and stretch.equal == stretch.ticks for stretch in again)
    assert (folder / "thrust.svg").stat().st_size > 10_000
    again = f"optimise --resume {folder} --budget"
    assert f"To continue: fishctl {again} SECONDS" in done.stderr
    answer = json.loads((folder / "result.json").read_text())
    assert f"{1e3 * answer['thrust']:.2f} ± " in done.stdout, "not the luckiest of the candidates"
    assert find_answer(folder)[:3] == tuple(
        answer[key] for key in ("thrust", "thrust_ci95", "total_ci95")
    )
    assert re.match(r"best frequency [\d.]+ Hz \[", find_answer(folder).summary)
    table = (folder / "rows.csv").read_text()
    more = fishctl(*again.split(), "60")
    assert f"{folder}: 2 candidates measured already" in more.stdout
    assert (folder / "rows.csv").read_text().startswith(table)
    second = open_run(folder / "optimise-2.mcap").ticks
    assert len(second) > len(run.ticks) + 100
    kept = [[(tick.seq, tick.fx, tick.phi_c) for tick in ticks] for ticks in (run.ticks, second)]
    assert kept[1][: len(kept[0])] == kept[0], "as if it had not been interrupted"
    refused = one_line(fishctl(*words, "--resume", str(folder), "--amplitude", "0.3"))
    assert "began with parameters.amplitude = None, now it is 0.3" in refused
    assert "--resume" in one_line(fishctl(*words, "--folder", str(folder)))


@pytest.mark.slow
def test_a_search_that_is_interrupted_again_and_again_loses_no_candidate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = np.random.default_rng(5)
    tick = VirtualRun.tick
    left = 0

    def interrupted(run: VirtualRun) -> TrueWindow:
        nonlocal left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGINT)
        return tick(run)

    monkeypatch.setattr(VirtualRun, "tick", interrupted)
    folder = tmp_path / "run"
    table = folder / "rows.csv"
    words = ["optimise", "square", "--frequency", "1:3", "--folder", str(folder)]
    kept, stops = "", 0
    while True:
        left = int(generator.integers(1, 300)) if stops < 3 else 0
        done = fishctl(*words)
        words = ["optimise", "--resume", str(folder)]
        content = table.read_text()
        assert content.startswith(kept)
        kept = content
        if done.returncode == 0:
            break
        stops += 1
        assert done.returncode == 130
        assert done.stderr.startswith("fishctl: interrupted, ")
        assert done.stderr.endswith(f"; resume with: fishctl {' '.join(words)}\n")
    assert stops == 3
    assert "best frequency of square: 1.667 Hz" in done.stdout
    rows = [row.split(",") for row in kept.splitlines()[1:]]
    seconds = sum(len(read(path)) for path in folder.glob("optimise*.mcap")) * 0.05
    swims = sum(float(b[3]) - float(a[3]) for a, b in pairwise([[0.0] * 5, *rows])) * 0.05
    assert seconds > swims + 2.75 * len(rows)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--frequencie", ":"], "Did you mean one of: '--frequency'"),
        ([], "no parameter has a range: give one, such as --frequency LOW:HIGH, or --frequency :"),
        (["--frequency", "1:2:0.1"], "LOW:HIGH is needed, such as 0.5:4, or ':' for all"),
        (["--frequency", "a:2"], "'a' is not valid: a number"),
        (["--frequency", "3:1"], "is not a range: the lower end comes first"),
        (["--frequency", "1"], "no parameter has a range"),
        (["--frequency", "1:30"], "frequency"),
        (["--frequency", "1:8", "--set", "tick=0.1"], "8 Hz is too fast for ticks of 0.1 s"),
        (["--frequency", "1.5:1.9"], "in this range: 1.667; near it: 1.429, 1.667, 2"),
        (["--frequency", ":", "--budget", "5"], "too short"),
    ],
)
def test_what_cannot_be_searched_is_one_line(tmp_path: Path, words: list[str], named: str) -> None:
    folder = tmp_path / "run"
    done = fishctl("optimise", "square", *words, "--folder", str(folder))
    assert named in one_line(done)
    assert not folder.exists()
