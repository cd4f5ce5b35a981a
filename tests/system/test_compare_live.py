"""`fishctl compare --on live` and a running fishd: it may be interrupted at any time."""

import re
import signal
import subprocess
from pathlib import Path

import pytest
from rigs.processes import FISHCTL, PATIENCE, Daemon, wait_until

from fishd.client import Fish


@pytest.fixture(autouse=True)
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set the folder of all experiments."""
    monkeypatch.setenv("FISHD_RUNS", str(tmp_path))
    return tmp_path


def comparing(daemon: Daemon, *arguments: str) -> subprocess.Popen[str]:
    command = [FISHCTL, "--endpoint", daemon.endpoint, "compare", "--on", "live", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_signal_lets_the_fish_rest(daemon: Daemon, runs: Path) -> None:
    process = comparing(daemon, "swing", "sine")
    wait_until(lambda: daemon.status().mode == "running")
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out) == (130, f"fish: the fish of fishd at {daemon.endpoint}\n")
    (folder,) = runs.glob("[!.]*")
    resume = f"fishctl compare --resume {folder}"
    assert err == f"fishctl: interrupted, the fish rests; resume with: {resume}\n"
    assert daemon.status().mode == "idle"


def test_nobody_swims_on_where_somebody_stops_the_fish(daemon: Daemon) -> None:
    process = comparing(daemon, "swing", "sine")
    wait_until(lambda: daemon.status().mode == "running")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.stop()
    out, err = process.communicate(timeout=PATIENCE)
    assert (process.returncode, out.count("\n")) == (1, 1)
    assert re.fullmatch(
        r"fishctl: this program no longer holds the fish: the fish was stopped by hand[^\n]*\n", err
    )
    assert daemon.status().mode == "idle"


def test_a_latched_stop_and_a_wrong_option_are_one_line(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.estop("the net")
        done = daemon.fishctl("compare", "--on", "live", "swing")
        assert (done.returncode, done.stderr.count("\n")) == (1, 1)
        assert "the net" in done.stderr
        fish.clear_fault()
    for option in ("--settle=3", "--set=tick=0.02"):
        done = daemon.fishctl("compare", "--on", "live", "swing", option)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert option.partition("=")[0] in done.stderr
