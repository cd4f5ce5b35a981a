"""A real fishd and a real agent, in two processes, and failures of their connection."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from rigs.documents import FENCE, ROOT, text_of
from rigs.processes import (
    FISHD,
    PATIENCE,
    Daemon,
    Subscriber,
    call,
    fishctl,
    running,
    sets,
    wait_until,
)
from rigs.scripted_agent import ScriptedAgent

from fishd.client import Agent, Fish

AGENT = """
import sys
from fishd.client import Agent

with Agent(sys.argv[1]) as agent:
    print("bound", flush=True)
    for seen in agent:
        agent.act(0.25)
"""


@contextmanager
def agent_process(address: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run an agent that has bound its address."""
    process = subprocess.Popen([sys.executable, "-c", AGENT, address], stdout=subprocess.PIPE)
    try:
        assert process.stdout
        assert process.stdout.readline() == b"bound\n"
        yield process
    finally:
        process.kill()
        process.communicate(timeout=PATIENCE)


@pytest.fixture
def address(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/agent"


@pytest.mark.realtime
def test_an_agent_that_dies_leaves_a_fault_to_its_successor(daemon: Daemon, address: str) -> None:
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        with agent_process(address) as process:
            assert daemon.fishctl("set-controller", "remote", "--agent", address).returncode == 0
            ticks.until(controller="remote", phi_c=0.25)
            process.kill()
            process.wait(PATIENCE)
            seen = [ticks.message()]
            while seen[-1]["mode"] == "running":
                seen.append(ticks.message())
        angles = [tick["phi_c"] for tick in seen]
        assert angles[-5:] == [0.0] * 5  # the fifth is the fault
        assert angles[:-5][-1:] in ([], [0.25])
        reason = daemon.status().reason
        assert reason
        assert reason.code == "remote-silent"
        assert "has not answered within 20 ms, 5 ticks in a row" in reason.message
        with agent_process(address):
            refused = daemon.fishctl("set-controller", "remote", "--agent", address)
            assert refused.returncode == 1
            assert "has not answered within 20 ms" in refused.stderr
            assert daemon.fishctl("clear-fault").returncode == 0
            assert daemon.fishctl("set-controller", "remote", "--agent", address).returncode == 0
            ticks.until(mode="running", phi_c=0.25)


def test_no_late_action_reaches_the_servo(daemon: Daemon, tmp_path: Path) -> None:
    with (
        closing(ScriptedAgent(tmp_path)) as agent,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
        Subscriber(daemon.telemetry, b"tick") as telemetry,
    ):
        telemetry.connected()
        fish.set_controller("remote", agent=agent.address, misses=1000, first_action=PATIENCE)
        for _ in range(20):
            over = agent.next()["seq"]
            agent.next()  # that tick is over, however slow this machine is
            agent.send(agent.action(0.4, seq=over))
            agent.send(agent.action(-0.1))
        fish.stop()
        ticks = [telemetry.until(controller="remote")]
        while ticks[-1]["controller"] == "remote":
            ticks.append(telemetry.message())
    assert sum(seen["lost_ticks"] for seen in agent.seen) >= 20
    assert {tick["phi_c"] for tick in ticks[:-1]} == {0.0, -0.1}


def test_an_agent_learns_for_seconds_and_then_swims_on(daemon: Daemon, address: str) -> None:
    with Agent(address) as agent, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("remote", agent=address, misses=1000, first_action=PATIENCE)
        agent.observe()
        agent.act(0.2)
        agent.observe()
        agent.pause(30.0)
        time.sleep(1.0)  # twenty ticks
        agent.poll()  # one that was sent before the pause had come
        assert agent.poll(0.3) is None
        assert fish.status().mode == "running"
        agent.resume()
        before = fish.status().seq
        assert agent.observe().instruction_angle == 0.0
        agent.act(0.2)
        agent.observe()
        assert fish.status().seq >= before
        assert fish.status().mode == "running"


@pytest.mark.skipif(not Path("/proc/net/if_inet6").exists(), reason="a kernel without IPv6")
def test_an_agent_and_telemetry_may_be_reached_over_ipv6(tmp_path: Path) -> None:
    telemetry = sets("telemetry.address=tcp://[::1]:0")
    with (
        running(tmp_path, *telemetry) as daemon,
        Agent("tcp://[::1]:*", timeout=PATIENCE) as agent,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
    ):
        fish.set_controller("remote", agent=agent.address, first_action=PATIENCE)
        assert agent.observe().session
        assert next(fish.ticks()).controller == "remote"


def test_a_simulation_waits_for_its_agent(address: str) -> None:
    with agent_process(address):
        lengths = ("--seconds", "20", "--settle", "1")
        done = fishctl("simulate", "remote", "--agent", address, *lengths, "--json")
    report = json.loads(done.stdout)
    assert report["mode"] == "running"
    assert report["ticks"] == 400
    assert report["frequency"] == 0.0  # it holds 0.25 rad


@contextmanager
def waiting_daemon(folder: Path, address: str) -> Iterator[Daemon]:
    """Run a fishd in lockstep that waits for an agent in its first tick."""
    settings = ["lockstep=true", "start.controller=remote", f"start.parameters.agent={address}"]
    with running(folder, *sets(*settings)) as daemon:
        yield daemon


def test_in_lockstep_fishd_waits_for_its_agent_and_answers(tmp_path: Path, address: str) -> None:
    with (
        waiting_daemon(tmp_path, address) as daemon,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
    ):
        wait_until(lambda: fish.status().seq == 1)
        time.sleep(0.5)
        assert (fish.status().seq, fish.status().mode) == (1, "running")
        with Subscriber(daemon.telemetry, b"status") as telemetry:
            assert telemetry.message()["seq"] == 1
        with Agent(address) as agent:
            for seen in agent:
                assert seen.time == pytest.approx((seen.seq - 1) * 0.05)
                agent.act(0.1)
                if seen.seq == 400:  # 20 s of virtual time
                    break
            agent.observe()
            assert fish.status().seq == 401
            assert fish.status().missed_slots == 0


@pytest.mark.parametrize("request_", ["stop", "estop", "set-controller swing"])
def test_in_lockstep_a_request_ends_the_wait(tmp_path: Path, address: str, request_: str) -> None:
    with waiting_daemon(tmp_path, address) as daemon:
        begun = time.monotonic()
        assert daemon.fishctl(*request_.split()).returncode == 0
        with Subscriber(daemon.telemetry, b"tick") as ticks:
            first = ticks.message()
            assert first["controller"] == ("swing" if "swing" in request_ else "hold")
            while ticks.message()["seq"] < 20:
                pass
        assert time.monotonic() - begun > 0.8  # at the pace of real time, from tick 1


def test_in_lockstep_a_signal_ends_the_wait(tmp_path: Path, address: str) -> None:
    with waiting_daemon(tmp_path, address) as daemon:
        code, _, errors = daemon.end()
    assert code == 0
    assert "Traceback" not in errors


def test_the_example_of_the_documentation_swims_and_leaves_the_fish_at_rest(tmp_path: Path) -> None:
    document = text_of(ROOT / "docs" / "how-to" / "remote.md")
    example = next(block for kind, block in FENCE.findall(document) if kind == "python")
    assert "400" in example
    assert "agent=agent.address" in example
    brief = example.replace("400", "60")
    with (
        running(tmp_path, *sets("lockstep=true")) as daemon,
        Subscriber(daemon.telemetry, b"tick") as ticks,
        subprocess.Popen(
            [sys.executable, "-c", brief], env={"FISHD_ENDPOINT": daemon.endpoint}
        ) as process,
    ):
        try:
            ticks.until(controller="remote", phi_c=0.42)
            ticks.until(controller="remote", phi_c=-0.42)
            assert process.wait(PATIENCE) == 0
        finally:
            process.kill()
        assert daemon.status().mode == "idle"


def test_a_fishd_does_not_take_the_socket_of_an_agent(daemon: Daemon, address: str) -> None:
    with Agent(address) as agent, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        second = call(FISHD, *sets(f"control.address={address}"))
        assert second.returncode == 1
        assert f"already serves {address}" in second.stderr
        fish.set_controller("remote", agent=address)
        assert agent.observe().seq >= 1
