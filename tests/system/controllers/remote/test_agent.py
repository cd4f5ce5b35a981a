"""`Agent`, the Python class of agents, with the real controller `remote`."""

import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq
from rigs.harness import Rig
from rigs.processes import PATIENCE, wait_until
from rigs.scripted_agent import wait_for_connection

from fishd.client import Agent, FishError, NoDaemon
from fishd.core.errors import ParameterError
from fishd.core.signals import Tick


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[Agent]:
    with Agent(f"ipc://{tmp_path}/agent", timeout=PATIENCE) as agent:
        yield agent


@contextmanager
def swimming(rig: Rig, agent: Agent, ticks: int) -> Iterator[list[Tick]]:
    """Run `remote` for some ticks in another thread; yield the list that gets them at the end."""
    rig.start("remote", agent=agent.address)
    swum: list[Tick] = []

    def swim() -> None:
        swum.extend(rig.run(ticks))
        rig.loop.close()

    thread = threading.Thread(target=swim)
    thread.start()
    try:
        yield swum
    finally:
        agent.close()  # the loop must not wait for the agent, even after a failure
        thread.join(PATIENCE)


def test_it_takes_observations_and_answers_each(agent: Agent) -> None:
    rig = Rig("lockstep=true")
    with swimming(rig, agent, 20) as ticks:
        for seen in agent:
            agent.act(0.01 * seen.seq)
            if seen.seq == 20:
                break
        assert agent.poll(PATIENCE) is None  # None as soon as fishd reports the end
        assert not agent.active
    assert [tick.phi_c for tick in ticks] == pytest.approx([0.01 * n for n in range(1, 21)])


def test_a_pause_gives_the_observation_anew(agent: Agent) -> None:
    rig = Rig("lockstep=true")
    with swimming(rig, agent, 3) as ticks:
        for _ in range(3):
            before = agent.observe()
            agent.pause(60.0)
            time.sleep(0.1)
            agent.resume()
            assert agent.observe() == before
            assert agent.lost == 0
            agent.act(0.2)
        assert agent.poll(PATIENCE) is None
    assert [tick.phi_c for tick in ticks] == [0.2] * 3


def test_the_newest_of_several_observations_counts(agent: Agent) -> None:
    rig = Rig("tick=0.02")
    rig.start("remote", agent=agent.address)
    wait_for_connection(rig)
    rig.run(20)  # no agent answers
    taken, lost = 0, 0
    while lost < 19:  # `lost` counts observations taken at once; some may still be in transit
        latest = agent.observe()
        taken, lost = taken + 1, lost + agent.lost
    assert latest.time == pytest.approx(19 * 0.02)
    assert taken < 20
    rig.loop.close()


def test_a_fishd_that_comes_back_is_served_as_before(agent: Agent) -> None:
    sessions = set()
    for _ in range(3):
        rig = Rig("lockstep=true")
        rig.start("remote", agent=agent.address)
        thread = threading.Thread(target=lambda rig=rig: rig.run(5))
        thread.start()
        for _ in range(5):
            sessions.add(agent.observe().session)
            agent.act(0.3)
        thread.join(PATIENCE)
        assert [tick.phi_c for tick in rig.recorder.ticks] == [0.3] * 5
        rig.loop.close()
    assert len(sessions) == 3


def test_in_virtual_time_the_successor_of_an_agent_that_died_is_asked_again(tmp_path: Path) -> None:
    rig = Rig("lockstep=true")
    address = f"ipc://{tmp_path}/agent"
    first = Agent(address, timeout=PATIENCE)
    with swimming(rig, first, 3) as ticks:
        first.observe()
        first.act(0.1)
        unanswered = first.observe()
        first.close()
        with Agent(address, timeout=PATIENCE) as second:
            assert second.observe() == unanswered
            second.act(0.2)
            assert second.observe().answered_seq == unanswered.seq
            second.act(0.3)
            assert second.poll(PATIENCE) is None
    assert [tick.phi_c for tick in ticks] == [0.1, 0.2, 0.3]


def test_a_number_that_is_none_is_refused(agent: Agent) -> None:
    rig = Rig("tick=0.02")
    rig.start("remote", agent=agent.address)
    while not agent.poll(0.01):
        rig.run()
    for angle in (math.nan, math.inf):
        with pytest.raises(ParameterError, match="is not a number"):
            agent.act(angle)
    for seconds in (-1.0, 0.0, 3601.0, math.nan):
        with pytest.raises(ParameterError, match="more than 0, up to 3600"):
            agent.pause(seconds)
    rig.loop.close()


def test_when_nobody_asks_it_says_what_would_help() -> None:
    with Agent(timeout=0.05) as agent:
        assert agent.address.startswith("tcp://127.0.0.1:")
        with pytest.raises(NoDaemon) as caught:
            agent.observe()
        with pytest.raises(NoDaemon):
            agent.act(0.0)
    assert f"no observation has come to {agent.address} within 0.05 s" in str(caught.value)
    assert f"'fishctl set-controller remote --agent {agent.address}'" in str(caught.value)


def test_when_another_controller_takes_over_it_says_so(tmp_path: Path) -> None:
    rig = Rig("tick=0.02")
    with Agent(f"ipc://{tmp_path}/agent", timeout=0.3) as agent:
        rig.start("remote", agent=agent.address)
        while not agent.poll(0.01):
            rig.run()
        rig.start("hold")
        while agent.active:
            agent.poll(0.01)
        with pytest.raises(NoDaemon, match="another controller is active, or none"):
            agent.observe()


def test_what_is_no_message_of_a_fishd_is_left_aside(tmp_path: Path) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with Agent(f"ipc://{tmp_path}/agent", timeout=0.3) as agent:
        stranger = context.socket(zmq.DEALER)
        stranger.connect(agent.address)
        stranger.send(b'{"kind":"ended","session":"\xff"}')
        stranger.send(b"hello")
        wait_until(lambda: agent.poll() is None and "malformed" in agent._strange)
        with pytest.raises(NoDaemon, match="but an invalid message: JSON is malformed"):
            agent.observe()
    context.destroy(linger=0)


def test_a_second_agent_at_an_ipc_address_is_refused_and_the_first_goes_on(agent: Agent) -> None:
    with pytest.raises(FishError) as caught:
        Agent(agent.address)
    assert f"'{agent.address}': another program (pid {os.getpid()})" in str(caught.value)
    rig = Rig("lockstep=true")
    with swimming(rig, agent, 1) as ticks:
        agent.observe()
        agent.act(0.1)
        assert agent.poll(PATIENCE) is None
    assert ticks[0].phi_c == 0.1


@pytest.mark.parametrize(
    ("address", "complaint"),
    [
        ("tcp://127.0.0.1:99999", "99999 is not a port, 65535 is the highest"),
        ("ipc:///nowhere/agent", "choose an address in a folder that exists and that you may"),
        ("tcp://nowhere.invalid:*", "No such device"),
    ],
)
def test_where_no_agent_can_listen_is_said_in_one_line(address: str, complaint: str) -> None:
    with pytest.raises(FishError, match=r"^an agent cannot listen on '") as caught:
        Agent(address)
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)
