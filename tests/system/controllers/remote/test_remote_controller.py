"""The controller `remote` with agents on real sockets: deadlines, numbers, pauses, addresses."""

import math
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rigs.harness import LIMITS, Rig
from rigs.processes import wait_until
from rigs.scripted_agent import (
    ScriptedAgent,
    connect,
    reason,
    remote,
    run_answered_tick,
    swim,
    wait_for_connection,
    wait_for_message,
)

from fishd.controllers import registry
from fishd.core.errors import ParameterError


def test_an_action_is_applied_in_the_tick_it_answers(still: Rig, agent: ScriptedAgent) -> None:
    angles = {n: 0.4 * math.sin(n) for n in range(1, 51)}
    still.start("remote", agent=agent.address)
    with agent.answering(lambda seen: agent.action(angles[seen["seq"]])):
        ticks = still.run(50)
    assert [tick.phi_c for tick in ticks] == list(angles.values())
    assert [seen["seq"] for seen in agent.seen] == list(angles)
    for seen, tick in zip(agent.seen, ticks, strict=True):
        assert (seen["fx"], seen["fy"], seen["fy_rate"]) == (tick.fx, tick.fy, tick.fy_rate)
        assert seen["fin_velocity"] == tick.fin_velocity
        assert (seen["tick"], seen["amplitude"]) == (0.05, 0.42)
        assert seen["answered_seq"] == seen["seq"] - 1
        assert seen["lost_ticks"] == 0
    assert [seen["instruction_angle"] for seen in agent.seen[1:]] == list(angles.values())[:-1]


def test_an_angle_beyond_the_limit_is_clamped(still: Rig, agent: ScriptedAgent) -> None:
    still.start("remote", agent=agent.address)
    with agent.answering(lambda seen: agent.action(3.0)):
        assert still.run(3)[-1].phi_c == 0.42


def test_virtual_time_waits_for_a_slow_agent(still: Rig, agent: ScriptedAgent) -> None:
    def slowly(seen: dict[str, Any]) -> dict[str, Any]:
        time.sleep(0.2)  # four ticks
        return agent.action(0.1)

    still.start("remote", agent=agent.address, misses=1)
    with agent.answering(slowly):
        assert [tick.phi_c for tick in still.run(3)] == [0.1] * 3
    assert still.mode == "running"


def test_silence_is_neutral_and_after_some_ticks_a_fault(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, deadline=0.03)
    swim(rig, agent)
    ticks = rig.run(4)
    assert [(tick.phi_c, tick.mode) for tick in ticks] == [(0.0, "running")] * 4
    assert rig.run()[-1].mode == "fault"
    assert rig.reason == "remote-silent"
    assert reason(rig) == (
        f"controller remote gave up: the agent at {agent.address} has not answered within 30 ms, "
        "5 ticks in a row (it has sent nothing since)"
    )
    assert rig.loop.active.name == "hold"


def test_one_answer_in_time_forgives_the_silence_before(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, misses=3, deadline=0.001)
    swim(rig, agent)
    for _ in range(6):
        assert {tick.phi_c for tick in rig.run(2)} == {0.0}
        assert run_answered_tick(rig, agent, 0.2).phi_c == 0.2
    assert rig.mode == "running"


def test_the_first_action_may_take_its_time_at_neutral(rig: Rig, agent: ScriptedAgent) -> None:
    rig.start("remote", agent=agent.address, first_action=2.0, deadline=0.001)
    assert {tick.phi_c for tick in rig.run_for(1.8)} == {0.0}
    assert rig.mode == "running"
    rig.run()
    assert rig.reason == "remote-silent"
    assert "no action has come from" in reason(rig)
    assert "within 2 s; start the agent, and check its address" in reason(rig)


def test_a_host_that_no_name_server_knows_is_named(rig: Rig) -> None:
    rig.start("remote", agent="tcp://fish_1.invalid:9873", first_action=2.0, deadline=0.001)
    rig.run()
    wire = remote(rig)._wire
    wait_until(lambda: bool(wire.problem))
    rig.run_for(2.0)
    assert rig.reason == "remote-silent"
    assert "within 2 s; the name fish_1.invalid is not known" in reason(rig)


def test_a_late_action_is_for_no_other_tick(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, deadline=0.02)
    for _ in range(10):
        agent.send(agent.action(0.3))  # the tick that asked is over
        wait_for_message(rig)
        assert rig.run()[-1].phi_c == 0.0
        agent.drain()
    assert agent.seen[-1]["answered_seq"] == 0
    rig.run(10)  # the ten ticks have not counted as a first action
    assert rig.mode == "running"


def test_what_was_lost_is_told_with_the_next_observation(rig: Rig, agent: ScriptedAgent) -> None:
    first = connect(rig, agent, misses=100)
    silent = {first["seq"] + n for n in (3, 4, 8)}
    with agent.answering(
        lambda seen: None if seen["seq"] in silent or seen["seq"] < 2 else agent.action(0.1)
    ):
        ticks = rig.run(14)
    while agent.seen[-1]["seq"] < remote(rig)._seq:
        agent.next()
    angles = {round(n * 0.2, 6): tick.phi_c for n, tick in enumerate(ticks, rig.index - 14)}
    seen = [message for message in agent.seen if message["seq"] > first["seq"]]
    assert [message["seq"] for message in seen] == [first["seq"] + n for n in range(1, 15)]
    for before, after in pairwise(seen):
        applied = angles[round(before["time"], 6)] != 0.0
        assert not (applied and before["seq"] in silent)
        assert after["lost_ticks"] == (0 if applied else 1)
        assert (after["answered_seq"] == before["seq"]) == applied


def test_a_pause_is_neutral_silent_and_ends_when_it_is_told(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, misses=2)
    swim(rig, agent)
    before = agent.seen[-1]
    agent.send(agent.pause(100.0))
    wait_for_message(rig)
    assert {tick.phi_c for tick in rig.run(50)} == {0.0}
    assert remote(rig)._seq == before["seq"]
    agent.send(agent.pause(0.0))
    wait_for_message(rig)
    rig.run()
    fresh = agent.next()
    assert fresh["seq"] == before["seq"] + 1
    assert fresh["answered_seq"] == before["seq"]
    assert fresh["lost_ticks"] == 0
    assert fresh["time"] == pytest.approx((rig.index - 1) * 0.2)
    assert rig.mode == "running"


@pytest.mark.realtime
def test_a_pause_in_place_of_an_action_ends_the_wait(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, misses=1)
    with agent.answering(lambda seen: agent.pause(1.0)):
        begun = time.monotonic()
        rig.run(5)
    assert rig.mode == "running"
    assert time.monotonic() - begun < 0.3  # not five deadlines of 80 ms


def test_after_its_time_a_pause_is_silence(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, misses=2)
    swim(rig, agent)
    rig.retune(deadline=0.001)
    agent.send(agent.pause(1.0))
    wait_for_message(rig)
    rig.run(5)
    assert rig.mode == "running"
    rig.run(2)
    assert rig.reason == "remote-silent"


def test_virtual_time_stands_still_in_a_pause(still: Rig, agent: ScriptedAgent) -> None:
    def pausing(seen: dict[str, Any]) -> dict[str, Any] | None:
        if agent.seen.count(seen) == 1:  # and again after the pause
            for seconds in (30.0, 20.0, 0.0, 0.0):
                agent.send(agent.pause(seconds))
            return None
        return agent.action(0.1)

    still.start("remote", agent=agent.address)
    with agent.answering(pausing):
        ticks = still.run(5)
    assert [tick.phi_c for tick in ticks] == [0.1] * 5
    assert [seen["seq"] for seen in agent.seen] == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]


def test_each_take_over_is_a_session_whose_end_is_told(rig: Rig, agent: ScriptedAgent) -> None:
    first = connect(rig, agent)["session"]
    second = connect(rig, agent)["session"]
    rig.start("hold")
    assert first != second
    while agent.next()["kind"] != "ended":
        pass
    ended = [m["session"] for m in agent.seen if m["kind"] == "ended"]
    assert ended == [first, second]


@pytest.mark.realtime
def test_an_agent_that_does_not_read_costs_no_time(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, deadline=1e-4, first_action=3600.0)
    begun = time.monotonic()
    rig.run(3000)  # more than any buffer holds
    assert time.monotonic() - begun < 3000 * 0.005
    assert rig.mode == "running"
    rig.start("hold")
    assert rig.mode == "running"


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"agent": "localhost"}, "agent: 'localhost' is not valid: tcp://HOST:PORT or ipc://PATH"),
        ({"agent": "tcp://*:1"}, "* is what an agent binds, here give the host that it runs on"),
        ({"agent": "tcp://127.0.0.1:0"}, "0 is what an agent binds, here give the port"),
        ({"agent": "ipc:///" + 119 * "a"}, "at most 107 bytes, this one has 120"),
        ({"deadline": 0.024}, "deadline: 0.024 s is not valid: at most 0.0225 s, 0.45 of a tick"),
    ],
)
def test_parameters_that_cannot_work_are_refused(values: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ParameterError, match="remote: ") as caught:
        registry.check("remote", values, LIMITS)
    assert complaint in str(caught.value)


def test_another_program_that_listens_there_after_the_agent_has_ended_is_not_asked(
    rig: Rig, agent: ScriptedAgent, tmp_path: Path
) -> None:
    connect(rig, agent)
    swim(rig, agent)
    agent.close()
    with closing(ScriptedAgent(tmp_path)) as stranger:
        rig.run(5)
        time.sleep(0.15)  # in which another connection would be made
        rig.run()
        assert not stranger.has_message()
    assert rig.reason == "remote-silent"
    assert "(its connection was lost: select remote again)" in reason(rig)


def test_before_the_first_action_an_agent_that_was_started_again_is_asked(
    rig: Rig, agent: ScriptedAgent, tmp_path: Path
) -> None:
    connect(rig, agent)
    agent.close()
    with closing(ScriptedAgent(tmp_path)) as successor:
        wait_for_connection(rig)
        rig.run()
        assert successor.next()["answered_seq"] == 0


def test_deadlines_change_while_it_swims_the_agent_stays(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent)
    rig.retune(misses=7)
    assert rig.loop.active.controller.parameters.misses == 7
    with pytest.raises(ParameterError, match=r"set-controller remote --agent tcp://"):
        rig.retune(agent="tcp://127.0.0.1:9873")
