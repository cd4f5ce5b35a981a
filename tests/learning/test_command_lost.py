"""A fish that was taken from its agent: the true reason, and a reset that begins anew."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from processes import Daemon, running

pytest.importorskip("gymnasium", reason="the extra 'learn' is not installed")

from fishd.client import Agent, Fish, FishError
from fishd.config import load
from fishd.learning.environment import SwimEnv
from fishd.learning.link import LinkLost
from fishd.learning.on_daemon import OnDaemon
from fishd.learning.settings import EnvironmentSettings

SETTINGS = ("--set", "tick=0.1")
HALF = np.full(1, 0.5, np.float32)


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    """A fishd in real time, in which an agent on a busy machine may lose ticks but no training."""
    with running(tmp_path, *SETTINGS) as found:
        yield found


@pytest.fixture
def env(daemon: Daemon) -> Iterator[SwimEnv]:
    """Swims already."""
    settings = EnvironmentSettings(longest_start=0)
    made = SwimEnv(OnDaemon(daemon.endpoint), load(None, ["tick=0.1"]), settings)
    made.reset()
    made.step(HALF)
    yield made
    made.close()


@pytest.fixture
def fish(daemon: Daemon) -> Iterator[Fish]:
    with Fish(daemon.endpoint) as fish:
        yield fish


def swims(env: SwimEnv) -> bool:
    """Is what a step observes a consequence of its action?"""
    return any(env.step(HALF)[4]["lost"] == 0 for _ in range(20))


def swim_for_ever(env: SwimEnv) -> None:
    while True:
        env.step(HALF)


def test_a_reset_in_command_swims_on_without_a_lost_tick(env: SwimEnv, fish: Fish) -> None:
    lost = 0
    for _ in range(10):
        before = env.latest
        env.reset()
        assert env.latest.time - before.time < 0.15
        lost += env.step(HALF)[4]["lost"]
    assert lost < 5
    assert fish.status().mode == "running"


def test_a_reset_after_a_stop_takes_command_again(env: SwimEnv, fish: Fish) -> None:
    fish.stop()
    stopped = fish.status().seq
    time.sleep(0.3)
    env.reset()
    assert fish.status().mode == "running"
    assert fish.status().seq > stopped
    assert swims(env)


def test_a_reset_does_not_take_the_fish_from_another_controller(env: SwimEnv, fish: Fish) -> None:
    fish.set_controller("swing")
    for _ in range(2):
        with pytest.raises(LinkLost, match="another controller has taken command: swing; 'fishctl"):
            env.reset()
    assert fish.status().controller == "swing"
    fish.stop()
    env.reset()
    assert swims(env)


def test_another_agent_in_command_is_named(env: SwimEnv, fish: Fish, tmp_path: Path) -> None:
    with Agent(f"ipc://{tmp_path}/other") as other:
        fish.set_controller("remote", agent=other.address)
        with pytest.raises(LinkLost, match=f"another agent has taken command: {other.address}"):
            env.reset()


def test_a_reset_in_a_fault_says_why_and_works_once_it_is_cleared(env: SwimEnv, fish: Fish) -> None:
    while fish.status().mode != "fault":
        time.sleep(0.02)  # nobody answers
    with pytest.raises(LinkLost, match="has not answered within"):
        env.reset()
    fish.clear_fault()
    env.reset()
    assert swims(env)


def test_a_reset_in_an_emergency_stop_says_why(env: SwimEnv, fish: Fish) -> None:
    fish.estop("water on the floor")
    with pytest.raises(LinkLost, match="fishd is in mode estop: water on the floor"):
        env.step(HALF)
    with pytest.raises(LinkLost, match="water on the floor"):
        env.reset()
    fish.clear_fault()
    env.reset()
    assert swims(env)


def test_a_reset_in_a_pause_ends_it(env: SwimEnv) -> None:
    env.pause(60.0)
    env.reset()
    assert swims(env)


def test_a_restart_of_fishd_is_told_from_a_stop(tmp_path: Path) -> None:
    with running(tmp_path, *SETTINGS) as first:
        env = SwimEnv(
            OnDaemon(first.endpoint), load(None, ["tick=0.1"]), EnvironmentSettings(longest_start=0)
        )
        env.reset()
        first.process.kill()
        first.process.wait()
    with running(tmp_path, *SETTINGS) as second:
        pids = f"it is process {second.process.pid} now, and was {first.process.pid}"
        with pytest.raises(LinkLost, match=f"^fishd was restarted: {pids}$"):
            swim_for_ever(env)
        env.reset()
        assert swims(env)
        env.close()
        with Fish(second.endpoint) as fish:
            assert fish.status().mode == "idle"


def test_a_closed_link_says_so(env: SwimEnv) -> None:
    link = env.link
    link.close()
    link.close()
    for use in (link.start, link.resume, lambda: link.step(0.1), lambda: link.pause(1.0)):
        with pytest.raises(LinkLost, match="this link to fishd is closed"):
            use()


def test_an_address_that_no_agent_can_have_is_refused(daemon: Daemon) -> None:
    with pytest.raises(FishError, match="99999 is no port"):
        OnDaemon(daemon.endpoint, address="tcp://127.0.0.1:99999")
