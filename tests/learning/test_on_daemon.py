"""The link to a running fishd: the same numbers as in process, and honest about what was lost."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from processes import Daemon, Subscriber, running

pytest.importorskip("gymnasium", reason="the extra 'learn' is not installed")

from fishd.client import Fish, NoDaemon
from fishd.config import load
from fishd.learning.environment import SwimEnv
from fishd.learning.in_process import InProcess
from fishd.learning.link import Link, LinkLost
from fishd.learning.on_daemon import OnDaemon
from fishd.learning.settings import EnvironmentSettings

FISH = ["simulation.noise=1e-3", "simulation.offset_y=5e-3", "simulation.seed=7"]


def options(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


@contextmanager
def lockstep(folder: Path) -> Iterator[Daemon]:
    """A fishd whose first tick waits for its agent already."""
    agent = f"start.parameters.agent=ipc://{folder}/agent"
    with running(folder, *options("lockstep=true", "start.controller=remote", agent, *FISH)) as it:
        yield it


@contextmanager
def linked(daemon: Daemon, deadline: float | None = None) -> Iterator[OnDaemon]:
    link = OnDaemon(daemon.endpoint, deadline=deadline)
    try:
        yield link
    finally:
        link.close()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    """A fishd in real time, in which an agent on a busy machine may lose ticks but no training."""
    with running(tmp_path, *options("tick=0.1")) as found:
        yield found


def swim_for_ever(link: Link) -> None:
    while True:
        link.step(0.3)


def history(link: Link, steps: int, pause_every: int = 0) -> list[tuple[bytes, float, int]]:
    """What an agent sees that acts at random, always in the same way."""
    env = SwimEnv(link, load(None, FISH), EnvironmentSettings(episode=100))
    draw = np.random.default_rng(4)
    seen = [(env.reset(seed=3)[0].tobytes(), 0.0, 0)]
    for step in range(1, steps + 1):
        observed, reward, _, truncated, info = env.step(draw.uniform(-1, 1, 1).astype(np.float32))
        seen.append((observed.tobytes(), float(reward), info["lost"]))
        if truncated:
            seen.append((env.reset()[0].tobytes(), 0.0, 0))
        if pause_every and step % pause_every == 0:
            env.pause(60.0)
            seen.append((env.resume().tobytes(), 0.0, 0))
    env.close()
    return seen


def test_a_fishd_in_lockstep_gives_the_numbers_of_a_fish_in_process(tmp_path: Path) -> None:
    with lockstep(tmp_path) as daemon:
        there = history(OnDaemon(daemon.endpoint), 300)
    assert there == history(InProcess(load(None, FISH)), 300)


def test_pauses_change_nothing_in_lockstep(tmp_path: Path) -> None:
    with lockstep(tmp_path) as daemon:
        there = history(OnDaemon(daemon.endpoint), 300, pause_every=64)
    assert there == history(InProcess(load(None, FISH)), 300, pause_every=64)


def test_it_swims_a_fishd_in_real_time(daemon: Daemon) -> None:
    with linked(daemon) as link, Subscriber(daemon.telemetry, b"tick") as telemetry:
        assert (link.tick, link.amplitude) == (0.1, 0.42)
        before = link.start()
        told: dict[float, float] = {}
        for n in range(20):
            angle = 0.02 * (n + 1)
            found, lost = link.step(angle)
            if not lost:
                told[before.fx] = angle
                assert found.time == pytest.approx(before.time + 0.1)
                assert found.instruction_angle == pytest.approx(angle)
            before = found
        assert len(told) > 10
        applied: dict[float, float] = {}
        while before.fx not in applied:
            tick = telemetry.message()
            applied[tick["fx"]] = tick["phi_c"]
    # What the agent was told did happen in the tick that it had observed, says telemetry.
    assert told == {fx: applied[fx] for fx in told}


def test_a_late_action_is_reported_as_lost(daemon: Daemon) -> None:
    with linked(daemon) as link:
        link.start()
        for _ in range(3):
            while link.step(0.3).lost:
                pass
            time.sleep(0.15)  # beyond the deadline, and the next tick
            assert link.step(0.3).lost >= 1


def test_a_pause_is_at_neutral_and_what_follows_is_fresh(daemon: Daemon) -> None:
    with linked(daemon) as link, Fish(daemon.endpoint) as fish:
        before = link.start()
        before = link.step(0.3).observation
        link.pause(30.0)
        seq = fish.status().seq
        while fish.status().seq < seq + 12:  # more ticks than it may miss
            time.sleep(0.02)
        after = link.resume()
        assert after.time >= before.time + 1.0
        assert after.instruction_angle == 0.0
        assert fish.status().mode == "running"
        assert link.step(0.3).observation.time > after.time


def test_a_fault_ends_it_with_the_reason_of_fishd(daemon: Daemon) -> None:
    with linked(daemon) as link, Fish(daemon.endpoint) as fish:
        link.start()
        link.step(0.3)
        while fish.status().mode != "fault":
            time.sleep(0.02)
        with pytest.raises(LinkLost, match=r"fishd is in mode fault: .* has not answered within"):
            link.step(0.3)
        with pytest.raises(LinkLost, match="fishd is in mode fault"):
            link.pause(1.0)
        with pytest.raises(LinkLost, match="fishd is in fault"):
            link.start()
        fish.clear_fault()
        assert link.start().time > 0.0
        assert link.step(0.3).observation.fx


def test_an_emergency_stop_ends_it_with_its_message(daemon: Daemon) -> None:
    with linked(daemon) as link:
        link.start()
        daemon.fishctl("estop", "water on the floor")
        with pytest.raises(LinkLost, match="fishd is in mode estop: water on the floor"):
            link.step(0.3)


def test_another_controller_ends_it(daemon: Daemon) -> None:
    with linked(daemon) as link:
        link.start()
        daemon.fishctl("set-controller", "swing")
        with pytest.raises(LinkLost, match="another controller has taken command: swing"):
            link.step(0.3)
    assert json.loads(daemon.fishctl("status", "--json").stdout)["controller"] == "swing"


def test_a_stop_ends_it(daemon: Daemon) -> None:
    with linked(daemon) as link:
        link.start()
        daemon.fishctl("stop")
        with pytest.raises(LinkLost, match="fishd was told to stop"):
            link.step(0.3)


def test_a_fishd_that_is_gone_ends_it(tmp_path: Path) -> None:
    with running(tmp_path) as daemon, linked(daemon) as link:
        link.start()
        daemon.process.kill()
        daemon.process.wait()
        with pytest.raises(LinkLost, match="no fishd at ipc://"):
            swim_for_ever(link)


def test_at_its_end_the_fish_is_at_rest(daemon: Daemon) -> None:
    with linked(daemon) as link:
        link.start()
        link.step(0.3)
        link.close()
    with Fish(daemon.endpoint) as fish:
        assert fish.status().mode == "idle"


def test_there_is_no_new_fish(daemon: Daemon) -> None:
    with linked(daemon) as link, pytest.raises(RuntimeError, match="cannot begin anew"):
        link.restart(0)


def test_without_a_fishd_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(NoDaemon, match="nobody listens there"):
        OnDaemon(f"ipc://{tmp_path}/nobody")
