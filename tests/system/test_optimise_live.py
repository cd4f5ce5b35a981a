"""`fishctl optimise --on live` on a real fishd: its state after a signal, and how it resumes."""

import signal
from pathlib import Path

import pytest
from rigs.processes import EXPERIMENT, Daemon, Process, fishctl, one_line, wait_until


@pytest.mark.slow
def test_an_interrupted_search_rests_the_fish_and_goes_on(daemon: Daemon, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    table = folder / "rows.csv"
    words = ["--endpoint", daemon.endpoint, "optimise", "square", "--frequency", "1:3"]
    words += ["--on", "live", "--folder", str(folder)]
    searching = Process(*EXPERIMENT, *words)
    wait_until(lambda: table.exists() and table.read_text().count("\n") >= 2)
    wait_until(lambda: daemon.status().mode == "running")
    status, out, err = searching.end(signal.SIGINT)
    assert status == 130
    assert daemon.status().mode == "idle"
    done = table.read_text().count("\n") - 1
    candidates = "1 candidate" if done == 1 else f"{done} candidates"
    assert f"{candidates}, " in out
    assert "s of waiting for candidates" in out
    assert err.endswith(f"resume with: fishctl optimise --resume {folder}\n")
    again = fishctl("optimise", "--resume", str(folder), "--budget", "12")
    assert again.returncode == 1
    assert f"{folder}: {candidates} measured already" in again.stdout
    assert "the budget of 12 s is used" in again.stderr


def test_what_the_fish_cannot_do_is_not_begun(daemon: Daemon, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = ["optimise", "square", "--on", "live", "--folder", str(folder)]
    for name, range_, named in (
        ("frequency", "1:30", "[0.001, 10]"),
        ("amplitude", "0.1:0.6", "(0, 0.42]"),
    ):
        refused = daemon.fishctl(*words, f"--{name}", range_)
        assert refused.returncode == 1
        assert f"is not within {named}" in refused.stderr
    words[1] = "sine"
    assert "less than 10 Hz" in one_line(daemon.fishctl(*words, "--frequency", "1:10"))
    assert not folder.exists()
