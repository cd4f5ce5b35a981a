"""The shortest dwell that `remote` may be given: off by default, and who takes over."""

from rigs.harness import Rig
from rigs.scripted_agent import ScriptedAgent


def flip(agent: ScriptedAgent, seen: dict[str, float]) -> dict[str, object]:
    return agent.action(0.42 if seen["instruction_angle"] <= 0.0 else -0.42)


def test_without_a_dwell_an_agent_may_reverse_in_every_tick(
    still: Rig, agent: ScriptedAgent
) -> None:
    still.start("remote", agent=agent.address)
    with agent.answering(lambda seen: flip(agent, seen)):
        angles = [tick.phi_c for tick in still.run(100)]
    assert angles == [0.42, -0.42] * 50
    assert still.loop.active.name == "remote"


def test_with_a_dwell_its_reversals_wait(still: Rig, agent: ScriptedAgent) -> None:
    still.start("remote", agent=agent.address, dwell=0.15)
    with agent.answering(lambda seen: flip(agent, seen)):
        angles = [tick.phi_c for tick in still.run(9)]
    assert angles == [0.42] * 3 + [-0.42] * 3 + [0.42] * 3
    # The agent is shown the angle that was sent.
    shown = [seen["instruction_angle"] for seen in agent.seen]
    assert shown == [0.0, *angles[:-1]]


def test_a_dwell_can_be_changed_in_flight(still: Rig, agent: ScriptedAgent) -> None:
    still.start("remote", agent=agent.address)
    with agent.answering(lambda seen: flip(agent, seen)):
        still.run(10)
        still.retune(dwell=0.1)
        angles = [tick.phi_c for tick in still.run(8)]
    assert angles == [0.42, 0.42, -0.42, -0.42] * 2


def test_an_agent_that_insists_loses_command_to_swing_and_is_told(
    still: Rig, agent: ScriptedAgent
) -> None:
    still.start("remote", agent=agent.address, dwell=0.2)
    with agent.answering(lambda seen: flip(agent, seen)):
        ticks = still.run(60)
    assert ([tick.controller for tick in ticks].index("swing"), ticks[-1].mode) == (39, "running")
    assert still.loop.active.fallback
    assert still.loop.active.fallback.message.startswith(
        "remote gave up: in 30 of the last 40 ticks"
    )
    agent.drain()
    assert agent.seen[-1]["kind"] == "ended"
