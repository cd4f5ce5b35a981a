"""The link to a running fishd: equal results to a simulated link, and reasons of lost control."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from rigs.processes import Daemon, Subscriber, running, sets

from fishd.client import Agent, Fish, FishError, NoDaemon
from fishd.config import load
from fishd.core.signals import Status
from fishd.learning.env.environment import SwimEnv
from fishd.learning.links.fishd_link import FishdLink
from fishd.learning.links.link import Link, LinkLost
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.settings import EnvironmentSettings

FISH = ["simulation.noise=1e-3", "simulation.offset_y=5e-3", "simulation.seed=7"]
HALF = np.full(1, 0.5, np.float32)
DEFAULT_MISSES, MANY_MISSES = 5, 100
"""Numbers of ticks that an agent may miss: the default, and more than a busy machine loses."""


DAEMON = sets("tick=0.1")
"""In real time: an agent on a busy machine may lose ticks, but not its control."""


@pytest.fixture
def fish(daemon: Daemon) -> Iterator[Fish]:
    with Fish(daemon.endpoint) as fish:
        yield fish


@pytest.fixture
def link(daemon: Daemon, fish: Fish) -> Iterator[FishdLink]:
    """A link to a swimming fish that may miss many ticks."""
    link = FishdLink(daemon.endpoint)
    link.reset()
    fish.set_parameters(misses=MANY_MISSES)
    while link.step(0.3).lost:
        pass
    yield link
    link.close()


def env_on(daemon: Daemon) -> SwimEnv:
    settings = EnvironmentSettings(longest_start=0)
    return SwimEnv(FishdLink(daemon.endpoint), load(None, ["tick=0.1"]), settings)


@pytest.fixture
def env(daemon: Daemon, fish: Fish) -> Iterator[SwimEnv]:
    """An environment of a swimming fish that may miss many ticks until control is reacquired."""
    env = env_on(daemon)
    env.reset()
    fish.set_parameters(misses=MANY_MISSES)
    assert swims(env)
    yield env
    env.close()


def swims(env: SwimEnv) -> bool:
    """Return whether a step observes a consequence of its action."""
    return any(env.step(HALF)[4]["lost"] == 0 for _ in range(20))


def swim_on(env: SwimEnv) -> None:
    """Swim a few steps, since an observation may have been sent before control was lost."""
    for _ in range(5):
        env.step(HALF)


def swim_for_ever(link: Link) -> None:
    while True:
        link.step(0.3)


@contextmanager
def losing(message: str) -> Iterator[None]:
    with pytest.raises(LinkLost, match=message):
        yield


def course(link: Link, steps: int, pause_every: int, ticks: int) -> list[tuple[bytes, float, int]]:
    """Return observations, rewards and lost ticks of a random agent with a fixed seed."""
    env = SwimEnv(link, load(None, FISH), EnvironmentSettings(episode=100, history=ticks))
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


@pytest.mark.parametrize(
    ("pause_every", "ticks"), [(0, 8), (64, 1)], ids=["with a history", "with pauses"]
)
def test_a_fishd_in_lockstep_gives_the_same_results_as_a_fish_in_process(
    tmp_path: Path, pause_every: int, ticks: int
) -> None:
    agent = f"start.parameters.agent=ipc://{tmp_path}/agent"
    settings = ("lockstep=true", "start.controller=remote", agent, *FISH)
    with running(tmp_path, *sets(*settings)) as daemon:  # its first tick waits for the agent
        there = course(FishdLink(daemon.endpoint), 300, pause_every, ticks)
    assert there == course(SimulatedLink(load(None, FISH)), 300, pause_every, ticks)


def test_a_link_swims_a_fishd_in_real_time_and_rests_it(daemon: Daemon, fish: Fish) -> None:
    link = FishdLink(daemon.endpoint)
    with Subscriber(daemon.telemetry, b"tick") as telemetry:
        assert (link.tick, link.amplitude) == (0.1, 0.42)
        telemetry.message()  # from here on no message is missed
        before = link.reset()
        fish.set_parameters(misses=MANY_MISSES)
        sent: dict[float, float] = {}
        for n in range(20):
            angle = 0.02 * (n + 1)
            after, lost = link.step(angle)
            if not lost:
                sent[before.fx] = angle
                passed = after.time - before.time  # a tick, or several on a busy machine
                assert passed == pytest.approx(0.1 * max(1, round(passed / 0.1)))
                assert after.instruction_angle == pytest.approx(angle)
            before = after
        assert len(sent) > 10
        applied: dict[float, float] = {}
        while before.fx not in applied:
            tick = telemetry.message()
            applied[tick["fx"]] = tick["phi_c"]
    # According to telemetry, each action was applied in the tick that the agent had observed.
    assert sent == {fx: applied[fx] for fx in sent}
    link.close()
    assert fish.status().mode == "idle"


def test_a_late_action_is_reported_as_lost(link: FishdLink) -> None:
    for _ in range(3):
        while link.step(0.3).lost:
            pass
        time.sleep(0.15)  # beyond the deadline, and the next tick
        assert link.step(0.3).lost >= 1


def test_a_pause_is_at_neutral_and_followed_by_fresh_data(link: FishdLink, fish: Fish) -> None:
    before = link.step(0.3).observation
    link.pause(30.0)
    fish.set_parameters(misses=DEFAULT_MISSES)
    seq = fish.status().seq
    while fish.status().seq < seq + 12:  # more ticks than the agent may miss
        time.sleep(0.02)
    fish.set_parameters(misses=MANY_MISSES)
    after = link.resume()
    assert after.time >= before.time + 1.0
    assert after.instruction_angle == 0.0
    assert fish.status().mode == "running"
    assert link.step(0.3).observation.time > after.time


@pytest.mark.realtime
def test_a_reset_in_control_swims_on_without_a_lost_tick(env: SwimEnv, fish: Fish) -> None:
    sessions, lost = set(), 0
    for _ in range(10):
        env.reset()
        sessions.add(env.latest.session)
        lost += env.step(HALF)[4]["lost"]
    assert len(sessions) == 1
    assert lost < 5
    assert fish.status().mode == "running"


def test_a_stop_ends_control_and_a_reset_reacquires_it(env: SwimEnv, fish: Fish) -> None:
    fish.stop()
    stopped = fish.status().seq
    with losing("fishd received a request to stop"):
        swim_on(env)
    env.reset()
    assert fish.status().mode == "running"
    assert fish.status().seq > stopped
    assert swims(env)


def test_a_close_that_takes_long_leaves_no_fault(
    link: FishdLink, fish: Fish, monkeypatch: pytest.MonkeyPatch
) -> None:
    status = Fish.status

    def slow(client: Fish) -> Status:
        fish.set_parameters(misses=DEFAULT_MISSES)
        seq = status(fish).seq
        while status(fish).seq < seq + 12:  # more ticks than the agent may miss
            time.sleep(0.02)
        return status(client)

    with monkeypatch.context() as patch:
        patch.setattr(Fish, "status", slow)
        link.close()
    final = fish.status()
    assert (final.mode, final.reason) == ("idle", None)


def test_another_controller_ends_control_and_a_reset_keeps_it(env: SwimEnv, fish: Fish) -> None:
    fish.set_controller("swing")
    with losing("another controller has taken command: swing"):
        swim_on(env)
    for _ in range(2):
        with losing("another controller has taken command: swing; 'fishctl stop' frees the fish"):
            env.reset()
    assert fish.status().controller == "swing"
    fish.stop()
    env.reset()
    assert swims(env)


def test_another_active_agent_is_named(env: SwimEnv, fish: Fish, tmp_path: Path) -> None:
    with Agent(f"ipc://{tmp_path}/other") as other:
        fish.set_controller("remote", agent=other.address)
        with losing(f"another agent has taken command: {other.address}"):
            for _ in range(100):  # until the agent has received that
                env.reset()
                time.sleep(0.02)


@pytest.mark.realtime
def test_a_fault_ends_control_with_its_reason_until_it_is_cleared(env: SwimEnv, fish: Fish) -> None:
    fish.set_parameters(misses=DEFAULT_MISSES)
    while fish.status().mode != "fault":
        time.sleep(0.02)  # the agent does not answer
    with losing(r"fishd is in mode fault: .* has not answered within"):
        swim_on(env)
    with losing("fishd is in mode fault"):
        env.pause(1.0)
    with losing("has not answered within"):
        env.reset()
    fish.clear_fault()
    env.reset()
    assert swims(env)


def test_an_emergency_stop_ends_control_with_its_message(env: SwimEnv, fish: Fish) -> None:
    fish.estop("water on the floor")
    with losing("fishd is in mode estop: water on the floor"):
        swim_on(env)
    with losing("water on the floor"):
        env.reset()
    fish.clear_fault()
    env.reset()
    assert swims(env)


def test_a_reset_ends_a_pause(env: SwimEnv) -> None:
    env.pause(60.0)
    env.reset()
    assert swims(env)


def test_a_fishd_that_is_gone_or_was_restarted_ends_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(Fish.__init__.__kwdefaults__, "timeout", 5.0)  # waits for one that is gone
    with running(tmp_path, *sets("tick=0.1")) as first:
        env = env_on(first)
        env.reset()
        first.process.kill()
        first.process.wait()
        with losing("no fishd at ipc://"):
            swim_for_ever(env.link)
    with running(tmp_path, *sets("tick=0.1")) as second:
        env.reset()
        assert swims(env)
        second.process.kill()
        second.process.wait()
    with running(tmp_path, *sets("tick=0.1")) as third, Fish(third.endpoint) as fish:
        pids = f"it is process {third.process.pid} now, and was {second.process.pid}"
        with losing(f"^fishd was restarted: {pids}$"):
            swim_for_ever(env.link)
        env.reset()
        fish.set_parameters(misses=MANY_MISSES)  # or there may be a fault before it is closed
        assert swims(env)
        env.close()
        assert fish.status().mode == "idle"


def test_a_closed_link_raises_an_error(link: FishdLink) -> None:
    link.close()
    link.close()
    for use in (link.reset, link.resume, lambda: link.step(0.1), lambda: link.pause(1.0)):
        with losing("this link to fishd is closed"):
            use()


def test_an_address_that_no_agent_can_have_is_refused(daemon: Daemon) -> None:
    with pytest.raises(FishError, match="99999 is not a port"):
        FishdLink(daemon.endpoint, address="tcp://127.0.0.1:99999")


def test_a_link_without_a_fishd_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NoDaemon, match="no process listens there"):
        FishdLink(f"ipc://{tmp_path}/nobody")
