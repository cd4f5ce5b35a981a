"""Agents that violate the protocol: invalid answers, and reversals in every tick."""

import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from rigs.harness import Rig
from rigs.processes import PATIENCE, wait_until
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

from fishd.core.agent_messages import Pause

GREETING_OF_2 = b"\xff" + bytes(8) + b"\x7f\x01\x05\x00\x00"
PLAIN = b"\xff" + bytes(8) + b"\x7f\x03\x01PLAIN" + bytes(47)


def _ended(connection: socket.socket) -> bool:
    """Return whether fishd has closed the connection."""
    connection.setblocking(False)
    with suppress(BlockingIOError):
        while connection.recv(4096):
            pass
        return True
    return False


def make_action(**changes: Any) -> dict[str, Any]:
    return {"kind": "action", "v": 2, "session": "s", "seq": 1, "phi_c": 0.1, **changes}


@pytest.mark.parametrize(
    ("rubbish", "complaint"),
    [
        (b"\xff\x00", "which is neither an action nor a pause"),
        (b'{"kind":"action","session":"\xff","seq":1,"phi_c":0.1}', "can't decode byte 0xff"),
        (b'{"a":' + 60_000 * b"[", "maximum recursion depth exceeded"),
        (b'{"kind":"action","v":2,"session":"s","seq":1,"phi_c":NaN}', "JSON is malformed"),
        (make_action(phi_c=None), "Expected `float`, got `null` - at `$.phi_c`"),
        (make_action(speed=1), "Object contains unknown field `speed`"),
        (make_action(kind="dance"), "Invalid value 'dance' - at `$.kind`"),
        (make_action(v=3, angle=1), "a message of version 3; this fishd needs version 2"),
        ({"kind": "pause", "v": 2, "session": "s", "seconds": -1}, "Expected `float` >= 0"),
    ],
)
def test_rubbish_is_a_fault_that_says_what_came(
    rig: Rig, agent: ScriptedAgent, rubbish: dict[str, Any] | bytes, complaint: str
) -> None:
    connect(rig, agent)
    agent.send(rubbish)
    wait_for_message(rig)
    rig.run()
    assert rig.reason == "remote-error"
    assert f"the agent at {agent.address} sent " in reason(rig)
    assert complaint in reason(rig)
    assert "\n" not in reason(rig)


class RawAgent:
    """Agent without ZeroMQ, which sends any bytes."""

    GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01NULL" + bytes(48)
    READY = b"\x04\x29\x05READY\x0bSocket-Type\0\0\0\x06ROUTER\x08Identity\0\0\0\0"

    def __init__(self, folder: Path) -> None:
        self.address = f"ipc://{folder}/raw"
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(f"{folder}/raw")
        self._listener.listen()
        self._listener.settimeout(PATIENCE)
        self._connection: socket.socket | None = None

    def accept(self) -> socket.socket:
        self._connection, _ = self._listener.accept()
        self._connection.settimeout(PATIENCE)
        return self._connection

    def close(self) -> None:
        for sock in (self._connection, self._listener):
            if sock:
                sock.close()


@pytest.fixture
def raw(tmp_path: Path) -> Iterator[RawAgent]:
    agent = RawAgent(tmp_path)
    yield agent
    agent.close()


@pytest.fixture
def connection(rig: Rig, raw: RawAgent) -> socket.socket:
    """Return the connection of the controller `remote` to the agent."""
    rig.start("remote", agent=raw.address)
    connection = raw.accept()
    connection.sendall(raw.GREETING + raw.READY)
    wait_for_connection(rig)
    return connection


@pytest.mark.parametrize(
    ("sent", "complaint"),
    [
        (100 * (b"\x01\xff" + bytes(255)), "a message of several frames; one frame of JSON"),
        (b"\x02" + (2**33).to_bytes(8, "big"), "a message of 8589934592 bytes; at most 65536"),
        (b"\x06" + (2**40).to_bytes(8, "big"), "a message of 1099511627776 bytes; at most 65536"),
    ],
)
def test_frames_without_end_are_a_fault_and_nothing_of_them_is_kept(
    rig: Rig, connection: socket.socket, sent: bytes, complaint: str
) -> None:
    connection.sendall(sent)
    wait_for_message(rig)
    assert len(remote(rig)._wire._received) <= 2 * 65536
    rig.run()
    assert rig.reason == "remote-error"
    assert complaint in reason(rig)


@pytest.mark.parametrize(
    "greeting", [b"HTTP/1.1 200 OK\r\n\r\n", GREETING_OF_2, PLAIN, bytes(64), b""]
)
def test_what_speaks_no_zeromq_is_no_agent(rig: Rig, raw: RawAgent, greeting: bytes) -> None:
    rig.start("remote", agent=raw.address, deadline=0.001)
    connection = raw.accept()
    connection.sendall(greeting)
    connection.shutdown(socket.SHUT_WR)
    wait_until(lambda: not remote(rig)._wire.state()[0] and _ended(connection))
    rig.run(3)
    assert rig.mode == "running"  # and waits for one
    assert remote(rig)._wire.connections == 0


def test_a_heartbeat_of_the_agent_is_answered(rig: Rig, connection: socket.socket) -> None:
    connection.sendall(b"\x04\x09\x04PING\x00\x10ab")
    received = b""
    while not received.endswith(b"\x04\x07\x04PONGab"):
        remote(rig)._wire.state()
        received += connection.recv(4096)


def test_heartbeats_of_an_agent_that_never_reads_take_no_memory(
    rig: Rig, connection: socket.socket
) -> None:
    wire, heartbeats = remote(rig)._wire, 1000 * b"\x04\x09\x04PING\x00\x10ab"
    for _ in range(300):  # their answers are more than the kernel keeps
        connection.sendall(heartbeats)
        wire.state()
    assert wire._unsent
    assert len(wire._unsent) < 64


def test_messages_that_come_byte_by_byte_are_put_together(rig: Rig, raw: RawAgent) -> None:
    rig.start("remote", agent=raw.address)
    connection = raw.accept()
    payload = b'{"kind":"pause","v":2,"session":"s","seconds":1}'
    for byte in raw.GREETING + raw.READY + b"\x00" + bytes([len(payload)]) + payload:
        connection.sendall(bytes([byte]))
        remote(rig)._wire.state()
    wait_for_message(rig)
    assert remote(rig)._wire.receive() == Pause(session="s", seconds=1.0)


@pytest.mark.parametrize(
    ("angle", "fill", "shown"), [(b"nul", 0, b'"phi_c":nul}'), (b"nul", 900, b'"phi_c":nul}')]
)
def test_what_is_shown_of_a_bad_message_is_where_it_is_bad(
    rig: Rig, agent: ScriptedAgent, angle: bytes, fill: int, shown: bytes
) -> None:
    session = connect(rig, agent)["session"].encode()
    head = b'{"kind":"action","v":2,' + fill * b" " + b'"session":"' + session + b'","seq":12,'
    agent.send(head + b'"phi_c":' + angle + b"}" + fill * b" ")
    wait_for_message(rig)
    rig.run()
    assert shown.decode() in reason(rig)
    assert ("…" in reason(rig)) == bool(fill)
    assert len(reason(rig)) < 450


@pytest.mark.parametrize("seq", [-3, 0, 2, 8, 10**18])
def test_an_action_for_nothing_sent_is_a_fault(rig: Rig, agent: ScriptedAgent, seq: int) -> None:
    assert connect(rig, agent)["seq"] == 1
    agent.send(agent.action(0.1, seq=seq))
    wait_for_message(rig)
    assert rig.run()[-1].phi_c == 0.0
    assert rig.reason == "remote-error"
    assert f"an action for observation {seq}, which was never sent; the latest is 1" in reason(rig)


@pytest.mark.parametrize(
    ("is_late", "count"), [(True, "5 answers were late"), (False, "5 were for another session")]
)
def test_answers_of_another_session_are_told_from_late_ones(
    rig: Rig, agent: ScriptedAgent, is_late: bool, count: str
) -> None:
    connect(rig, agent)
    swim(rig, agent)
    for _ in range(5):
        wrong = {"seq": remote(rig)._seq} if is_late else {"session": "0123"}
        assert run_answered_tick(rig, agent, 0.3, **wrong).phi_c == 0.0
    assert rig.reason == "remote-silent"
    assert f"5 ticks in a row ({count})" in reason(rig)


def test_before_the_first_action_wrong_answers_count_too(rig: Rig, agent: ScriptedAgent) -> None:
    connect(rig, agent, first_action=2.0)
    for _ in range(9):
        assert rig.mode == "running"
        run_answered_tick(rig, agent, 0.3, session="0123")
    assert rig.reason == "remote-silent"
    assert "no action has come in time from the agent at" in reason(rig)
    assert "(9 were for another session)" in reason(rig)


def flip(agent: ScriptedAgent, seen: dict[str, float]) -> dict[str, object]:
    return agent.action(0.42 if seen["instruction_angle"] <= 0.0 else -0.42)


def test_with_a_dwell_its_reversals_wait(still: Rig, agent: ScriptedAgent) -> None:
    still.start("remote", agent=agent.address, dwell=0.15)
    with agent.answering(lambda seen: flip(agent, seen)):
        angles = [tick.phi_c for tick in still.run(9)]
    assert angles == [0.42] * 3 + [-0.42] * 3 + [0.42] * 3
    # The agent receives the angle that was sent.
    shown = [seen["instruction_angle"] for seen in agent.seen]
    assert shown == [0.0, *angles[:-1]]


def test_a_dwell_can_be_changed_in_flight(still: Rig, agent: ScriptedAgent) -> None:
    still.start("remote", agent=agent.address)
    with agent.answering(lambda seen: flip(agent, seen)):
        assert [tick.phi_c for tick in still.run(10)] == [0.42, -0.42] * 5
        still.retune(dwell=0.1)
        angles = [tick.phi_c for tick in still.run(8)]
    assert angles == [0.42, 0.42, -0.42, -0.42] * 2


def test_an_agent_that_insists_is_told_and_swing_follows(still: Rig, agent: ScriptedAgent) -> None:
    still.start("remote", agent=agent.address, dwell=0.2)
    with agent.answering(lambda seen: flip(agent, seen)):
        ticks = still.run(60)
    assert ([tick.controller for tick in ticks].index("swing"), ticks[-1].mode) == (39, "running")
    assert still.loop.active.fallback.message.startswith("remote gave up: in 30 of the last 40 ")
    while agent.seen[-1]["kind"] != "ended":
        agent.next()
