"""Sweeps of a free swimmer, whose speed is averaged once it is steady."""

import csv
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rigs.coarse_swimmer import FILE, OPTIONS, UNDAMPED, coarse
from rigs.processes import fishctl, one_line

from fishd.config import Config
from fishd.lab.experiment import Header, open_experiment
from fishd.lab.sweep import figure
from fishd.lab.sweep.curves import best_to_builtins, find_best, make_curves
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import SpeedResult, SweepFolder
from fishd.lab.swimmer import refinement, speed
from fishd.lab.swimmer.refinement import GridSpeed, Refinement
from fishd.lab.swimmer.speed import FROM_REST, find_first_measured, is_steady, swim_freely

WAVE = Point("square", {"frequency": 3.0})


@pytest.fixture(scope="module")
def config() -> Config:
    return coarse(file=UNDAMPED)


def beats(speeds: np.ndarray, period: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Return the begin times of beats of these speeds, and the positions of the fish then."""
    way = np.concatenate([[0.0], np.cumsum(period * speeds)])
    return period * np.arange(len(speeds) + 1), -way


def test_the_start_is_dropped_until_the_mean_is_known_best() -> None:
    times = 0.5 * np.arange(40)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(40)
    first = find_first_measured(*beats(0.1 * (1.0 - np.exp(-times / 1.5)) + noise))
    assert 6 <= first <= 15
    assert find_first_measured(*beats(0.1 + noise)) <= 8


def test_a_speed_that_still_rises_is_not_steady_and_one_that_only_scatters_is() -> None:
    noise = 1e-3 * np.random.default_rng(2).standard_normal(20)
    assert is_steady(*beats(0.1 + noise), 0.1)
    assert not is_steady(*beats(0.1 + noise + 0.01 * np.arange(20) / 20), 0.1)
    assert is_steady(*beats(np.full(20, 0.1)), 0.1)
    assert not is_steady(*beats(np.full(20, 0.1), period=0.1), 0.1)  # of two seconds only


def test_a_fish_whose_speed_still_changes_is_judged_by_the_later_half_and_that_is_said(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "MAX_SWIM_S", 2.0)
    result = swim_freely(WAVE, config, Lengths(settle=0.3, periods=2), None)
    assert result
    assert (result.failure, result.settled_time, result.seconds) == ("", None, 2.0)
    assert result.beats == 2
    assert result.beat_frequency == pytest.approx(3.0, rel=0.03)
    assert result.speed is not None
    assert 0.01 < result.speed < 0.1


def test_a_fish_is_judged_as_soon_as_its_speed_is_steady(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fishd.lab.swimmer.speed.MIN_MEASURED_S", 0.5)
    monkeypatch.setattr("fishd.lab.swimmer.speed.STEADY_FRACTION", 0.5)
    result = swim_freely(WAVE, config, Lengths(settle=0.3, periods=2), None)
    assert result
    assert result.settled_time is not None
    assert 0.3 < result.settled_time < 1.0
    assert result.beats == 2
    assert result.seconds == pytest.approx(result.settled_time + 2.0 / 3.0, abs=0.05)


def test_beats_2_to_4_of_a_swim_from_rest_are_measured_steady_or_not(config: Config) -> None:
    result = swim_freely(WAVE, config, FROM_REST, None)
    assert result
    assert result.beats == 3
    assert result.settled_time == pytest.approx(1.0 / 3.0, abs=0.02)
    assert result.seconds == pytest.approx(4.0 / 3.0, abs=0.05)
    assert result.speed is not None
    assert 0.01 < result.speed < 0.1


def test_a_fish_that_is_lost_is_a_point_without_a_speed(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fishd.virtual.swimmer.fish.MAX_COURANT_NUMBER", 1e-6)
    result = swim_freely(WAVE, config, Lengths(settle=0.3, periods=2), None)
    assert result
    assert result.speed is None
    assert "the swimmer cannot go on at 0.033 s: the water passes" in result.failure


def test_a_swim_is_stopped_before_its_end(config: Config) -> None:
    lengths = Lengths(settle=0.1, periods=2)
    assert swim_freely(WAVE, config, lengths, None, stop=lambda: True) is None


def open_folder(path: Path, config: Config) -> SweepFolder:
    header = Header(kind="sweep", on="simulation", config=msgspec.to_builtins(config))
    with open_experiment(path, header, resume=(path / "experiment.json").exists()) as experiment:
        return SweepFolder(experiment, ["controller", "parameters.frequency", "parameters.C"])


def test_a_table_of_speeds_is_resumed_and_swing_is_drawn(tmp_path: Path, config: Config) -> None:
    folder = open_folder(tmp_path, config)
    points = [Point("square", {"frequency": value}) for value in (1.0, 2.0, 3.0, 4.0, 5.0)]
    points += [Point("swing", {"C": value}) for value in (0.0, 0.6)]
    speeds = (0.02, 0.05, 0.07, 0.06, 0.03, 0.06, 0.07)
    for point, mean_speed in zip(points, speeds, strict=True):
        result = SpeedResult(
            mean_speed, speed_ci95=1e-3, beat_frequency=2.9, settled_time=4.0, beats=10
        )
        folder.add_result(point, result, b"a recording")
    assert open_folder(tmp_path, config).results == folder.results
    curves = make_curves(folder, points)
    best = find_best(curves[0])
    assert best
    fields = best_to_builtins(best, folder.quantity)
    assert fields["speed"] == pytest.approx(0.07, abs=4e-3)
    assert "thrust" not in fields
    picture = tmp_path / "speed.svg"
    figure.draw([picture], curves, {"frequency": "Hz"}, error_of="it", quantity=folder.quantity)
    text = picture.read_text()
    assert all(label in text for label in ("speed (mm/s)", "swing C=0.6", "frequency (Hz)"))
    assert "<!-- C -->" not in text  # swing has no separate panel


@pytest.fixture
def _no_worker_stays() -> Any:
    from joblib.externals.loky import get_reusable_executor

    yield
    get_reusable_executor(reuse=True).shutdown(kill_workers=True)


@pytest.mark.slow
@pytest.mark.usefixtures("_no_worker_stays")
def test_a_sweep_of_swimmers_is_a_table_of_speeds_with_their_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "MAX_SWIM_S", 2.0)
    folder = tmp_path / "run"
    fast = ["--settle", "0.5", "--periods", "2", "--jobs", "1", "--folder", str(folder)]
    done = fishctl("sweep", "sine", "--frequency", "5", *OPTIONS, *fast)
    assert done.returncode == 0
    assert "sine frequency=5 Hz: " in done.stdout
    assert " mm/s, grid error not known (fishctl swimmer refine), 5.0" in done.stdout
    with (folder / "rows.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["strouhal"] or 1.0) > 0.0
    assert int(row["beats"]) >= 2
    assert (folder / row["recording"]).is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("_no_worker_stays")
def test_a_sweep_prints_ratios_to_the_fastest_gait_with_their_errors_by_the_grid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "MAX_SWIM_S", 2.0)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for frequency, speeds in ((5.0, (0.08, 0.10)), (3.0, (0.06, 0.09))):
        grids = zip((0.002, 0.001), speeds, strict=True)
        refinement.save(
            Refinement(
                fish=refinement.describe_fish(coarse()),
                controller="sine",
                parameters={"frequency": frequency, "amplitude": None},
                settled=True,
                grids=tuple(GridSpeed(cell=cell, step=1e-3, speed=speed) for cell, speed in grids),
            )
        )
    fast = ["--settle", "0.5", "--periods", "2", "--jobs", "1", "--folder", str(tmp_path / "run")]
    done = fishctl("sweep", "sine", "--frequency", "3,4,5", *OPTIONS, *fast)
    with (tmp_path / "run" / "rows.csv").open(newline="") as file:
        slow, _, quick = (float(row["speed"]) for row in csv.DictReader(file))
    names = ["sine frequency=3 Hz", "sine frequency=5 Hz"]
    if slow > quick:
        names.reverse()
    ratio = min(slow, quick) / max(slow, quick)
    share = 6.0 * (0.9 - 0.75) / 0.75 if slow < quick else 6.0 * (4.0 / 3.0 - 10.0 / 9.0) * 0.75
    assert f"{' / '.join(names)}: {ratio:.3f} ± {ratio * share:.3f} by the grid" in done.stdout
    assert done.stdout.count(" / ") == 1


def test_a_grid_with_a_fish_that_cannot_be_computed_is_refused_first(tmp_path: Path) -> None:
    words = ("sweep", "square", "--vary", "swimmer.numerics.cell=0.001,0.02")
    line = one_line(fishctl(*words, "--config", str(FILE), "--folder", str(tmp_path / "run")))
    assert "swimmer.numerics.cell" in line
    assert "too coarse" in line
    assert not (tmp_path / "run").exists()
