"""A swimmer in a running fishd: its time is slower than real time, and no tick is late."""

import signal
import socket
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.coarse_swimmer import OPTIONS
from rigs.processes import PATIENCE, Daemon, one_line, running, wait_until

from fishd.client import Agent, Fish

FACTOR = 4.0


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    slow = ("--set", f"swimmer.slow_motion={FACTOR}")
    with running(tmp_path_factory.mktemp("slow"), *OPTIONS, *slow) as daemon:
        yield daemon


def test_its_ticks_are_evenly_spaced_in_its_time_and_slow_for_people(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        ticks = fish.ticks()
        seen = [next(ticks) for _ in range(40)]
    first, last = seen[0], seen[-1]
    assert last.seq - first.seq == 39
    assert last.time - first.time == pytest.approx(0.39)
    assert last.t - first.t >= 0.9 * FACTOR * 0.39
    assert isinstance(last.speed, float)


def test_its_status_says_so_and_no_tick_is_late(daemon: Daemon) -> None:
    assert daemon.fishctl("set-controller", "swing").returncode == 0
    wait_until(lambda: daemon.status().seq > 20)
    status = daemon.status()
    (line,) = status.limitations
    assert line.startswith("slow motion: a second of the fish takes ")
    assert (status.robot, status.mode, status.controller) == ("swimmer", "running", "swing")
    assert (status.missed_slots, status.overruns, status.reason) == (0, 0, None)
    assert status.speed is not None
    assert "mm/s" in daemon.fishctl("status").stdout
    timing = daemon.fishctl("status", "--timing").stdout
    assert "in slow motion no tick is late" in timing
    assert "0 µs" not in timing


def test_it_has_no_zero_to_tare(daemon: Daemon) -> None:
    assert "this fish's force sensor has no zero to set" in one_line(daemon.fishctl("tare"))


def test_an_agent_sets_the_pace_however_slow_the_motion_is(tmp_path: Path) -> None:
    slow = ("--set", "swimmer.slow_motion=400")  # a tick in four seconds
    with (
        running(tmp_path, *OPTIONS, *slow) as daemon,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
        Agent(f"ipc://{tmp_path}/agent", timeout=PATIENCE) as agent,
    ):
        fish.set_controller("remote", agent=agent.address)
        first, begun = agent.observe(), time.monotonic()
        for _ in range(40):
            agent.act(0.2)
            last = agent.observe()
    assert last.seq - first.seq == 40
    assert time.monotonic() - begun < 80.0
    assert agent.lost == 0


def test_it_answers_feeds_systemd_and_ends_soon_however_slow_its_motion_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, slow = str(tmp_path / "notify"), ("--set", "swimmer.slow_motion=1000")
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(path)
        with running(tmp_path, *OPTIONS, *slow) as daemon:  # 10 s from tick to tick
            answered = Counter(daemon.status().seq for _ in range(20))
            assert max(answered.values()) > 6  # as many as a real tick of 10 ms permits
            systemd.settimeout(PATIENCE)
            feeds = 0
            while feeds < 4:
                feeds += b"WATCHDOG=1" in systemd.recv(1000)
            status, _, errors = daemon.end(signal.SIGTERM)
    assert status == 0, errors
    assert "hangs" not in errors
