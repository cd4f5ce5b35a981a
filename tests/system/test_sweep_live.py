"""`fishctl sweep --on live` and a running fishd: what it refuses, and how it ends."""

import signal
from pathlib import Path

from rigs.processes import EXPERIMENT, Daemon, Process, Subscriber, one_line, wait_until


def test_a_point_that_this_fish_cannot_swim_is_told_first(daemon: Daemon, tmp_path: Path) -> None:
    words = ("sweep", "square", "--on", "live", "--folder", str(tmp_path / "run"))
    with Subscriber(daemon.telemetry, b"event") as events:
        events.connected()
        complaint = one_line(daemon.fishctl(*words, "--amplitude", "0.3,0.41,0.6"))
        assert "amplitude_limit" in complaint
        words = ("sweep", "sine", *words[2:])
        assert "less than 10 Hz" in one_line(daemon.fishctl(*words, "--frequency", "8:10:1"))
        daemon.fishctl("mark", "nothing has moved")
        while (kind := events.message().get("kind")) != "mark":
            assert kind not in ("controller", "mode")
    assert not (tmp_path / "run").exists()


def test_a_closed_terminal_lets_the_fish_rest(daemon: Daemon, tmp_path: Path) -> None:
    words = ("sweep", "square", "--on", "live", "--folder", str(tmp_path / "run"))
    sweep = Process(*EXPERIMENT, "--endpoint", daemon.endpoint, *words, "--frequency", "1,2")
    wait_until(lambda: daemon.status().mode == "running")
    status, _, err = sweep.end(signal.SIGHUP)
    assert status == 130
    assert "interrupted, 0 of 2 points are kept; resume with: fishctl sweep --resume" in err
    assert daemon.status().mode == "idle"
