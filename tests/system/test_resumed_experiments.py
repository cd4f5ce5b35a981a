"""Experiments on a running fishd that are killed and resumed: nothing is measured again."""

import csv
import json
import signal
from pathlib import Path

import pytest
from rigs.processes import EXPERIMENT, Daemon, Process, call, running, wait_until

from fishd.core.errors import RecordingError
from fishd.recording import open_run

pytestmark = pytest.mark.realtime


def rows(folder: Path) -> list[dict[str, str]]:
    """Return the finished swims and rests of an experiment; none without a table."""
    path = folder / "swims.csv"
    return list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []


def start(daemon: Daemon, folder: Path, *words: str) -> Process:
    """Start an experiment on the fish of the daemon."""
    command = ("--endpoint", daemon.endpoint, *words, "--on", "live", "--folder", str(folder))
    return Process(*EXPERIMENT, *command)


def resume(daemon: Daemon, verb: str, folder: Path, *options: str) -> object:
    """Resume an experiment, after the lease of a killed one; return its JSON."""
    wait_until(lambda: daemon.status().lease is None)
    words = ("--resume", str(folder), "--endpoint", daemon.endpoint, "--json", *options)
    ended = call(*EXPERIMENT, verb, *words)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def count_swum(folder: Path) -> int:
    """Return the number of ticks of swimming in all recordings of an experiment."""
    try:
        runs = [open_run(path) for path in folder.glob("*.mcap*")]
    except RecordingError:  # it has just been created
        return 0
    return sum(sum(run.summary.swim_ticks.values()) for run in runs)


def test_a_killed_measurement_goes_on_with_its_next_swim(daemon: Daemon, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    measuring = start(daemon, folder, "measure", "square:frequency=1.7", "--for", "21")
    wait_until(lambda: len(rows(folder)) == 3)
    measuring.end(signal.SIGKILL)
    before = rows(folder)
    assert [row["controller"] for row in before] == ["", "square", ""]
    result = resume(daemon, "measure", folder)
    assert isinstance(result, dict)
    assert result["swims"] == 2
    assert result["seconds"] == pytest.approx(21.0, abs=0.3)
    assert result["frequency"] == pytest.approx(1.7, abs=0.1)
    after = rows(folder)
    assert (after[:3], len(after)) == (before, 5)
    planned = sum(int(row["ticks"]) for row in after if row["controller"])
    assert count_swum(folder) <= planned + 40
    assert resume(daemon, "measure", folder) == result
    assert rows(folder) == after


def test_an_interrupted_measurement_goes_on_with_another_fishd(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    with running(tmp_path_factory.mktemp("first")) as daemon:
        measuring = start(daemon, folder, "measure", "square:frequency=1.7", "--for", "21")
        wait_until(lambda: len(rows(folder)) == 3)
        status, _, err = measuring.end(signal.SIGINT)
        assert status == 130
        assert err.endswith(f"resume with: fishctl measure --resume {folder}\n")
    with running(tmp_path_factory.mktemp("second")) as daemon:
        result = resume(daemon, "measure", folder)
        assert isinstance(result, dict)
        assert result["swims"] == 2
        assert result["seconds"] == pytest.approx(21.0, abs=0.3)
    numbers = [int(row["first_tick"]) for row in rows(folder)]
    assert numbers != sorted(numbers)  # the ticks of the second fishd begin again


def test_a_killed_comparison_goes_on_with_its_next_swim(daemon: Daemon, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    contestants = ("square:frequency=1.7", "sine:frequency=1.7")
    comparing = start(daemon, folder, "compare", *contestants, "--for", "21")
    wait_until(lambda: len(rows(folder)) == 7)
    comparing.end(signal.SIGKILL)
    before = rows(folder)
    standings = resume(daemon, "compare", folder)
    assert isinstance(standings, list)
    assert tuple(standing["contestant"] for standing in standings) == contestants
    assert (rows(folder)[:7], len(rows(folder))) == (before, 10)


def test_a_killed_identification_swims_what_is_missing(daemon: Daemon, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    swims = start(daemon, folder, "identify", "--experiment", "--for", "40")
    wait_until(lambda: count_swum(folder) >= 200)
    swims.end(signal.SIGKILL)
    before = count_swum(folder)
    result = resume(daemon, "identify", folder, "--fit", "omega0")
    assert isinstance(result, dict)
    assert result["passages"] == 2
    total = count_swum(folder)
    assert before < total < 40 / 0.05
