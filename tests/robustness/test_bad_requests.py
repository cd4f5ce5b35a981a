"""Bad requests to the control socket: an error reply or silence, and never a missed tick."""

import json
import os
import signal
import threading
import time
from typing import Any

import msgspec
import pytest
import zmq
from rigs.processes import PATIENCE, Daemon, Subscriber, wait_until

from fishd.core.protocol import MAX_WAIT_S


def ask(socket: "zmq.Socket[bytes]", payload: bytes) -> dict[str, Any]:
    socket.send(payload)
    reply: dict[str, Any] = json.loads(socket.recv_multipart()[-1])
    return reply


SWING = {"name": "swing", "parameters": {"C": 7}}


@pytest.mark.parametrize("kind", [zmq.REQ, zmq.DEALER])
def test_both_kinds_of_socket_get_an_answer_with_their_id(daemon: Daemon, kind: int) -> None:
    with daemon.socket(kind) as socket:
        reply = ask(socket, b'{"v":2,"id":"a1","op":"status","args":{}}')
        failure = ask(socket, b"hello")
    assert (reply["v"], reply["id"], reply["ok"]) == (2, "a1", True)
    assert reply["result"]["mode"] == "idle"
    assert (failure["id"], failure["error"]["code"]) == (None, "bad-request")


def test_many_requests_sent_at_once_are_all_answered(daemon: Daemon) -> None:
    with daemon.socket() as socket:
        for number in range(60):
            socket.send(b'{"v":2,"id":%d,"op":"stop"}' % number)
        answered = {json.loads(socket.recv())["id"] for _ in range(60)}
    assert answered == set(range(60))


@pytest.mark.parametrize(
    ("request_", "code", "message"),
    [
        ({"v": 3, "op": "status"}, "version", "protocol version 3 is not supported, 2 is needed"),
        ({"op": "statsu"}, "unknown-op", "did you mean 'status'?"),
        ({"op": "set-controller"}, "bad-arguments", "name: is missing"),
        ({"op": "set-controller", "args": {"name": 3}}, "bad-arguments", "name: 3 is"),
        ({"op": "set-controller", "args": {"name": "x"}}, "unknown-controller", "'x'"),
        ({"op": "set-controller", "args": SWING}, "bad-parameter", "swing: C: 7 is not valid"),
        ({"op": "stop", "args": {"now": True}}, "bad-arguments", "now: unknown key"),
        ({}, "bad-request", "missing required field `op`"),
        ({"op": "set-parameter", "args": {"parameters": {}}}, "not-running", "idle"),
    ],
)
def test_a_bad_request_gets_an_error(
    daemon: Daemon, request_: dict[str, Any], code: str, message: str
) -> None:
    with daemon.socket() as socket:
        reply = ask(socket, msgspec.json.encode({"v": 2, "id": 1} | request_))
    assert (reply["ok"], reply["id"], reply["error"]["code"]) == (False, 1, code)
    assert message in reply["error"]["message"]
    assert "result" not in reply


def shoot(daemon: Daemon, seconds: float) -> None:
    """Send everything that a broken or hostile peer may send, as fast as possible, for a time."""
    garbage: list[list[bytes]] = [
        [b""],
        [b"", b""],
        [b"", b"", b""],
        [b"x"] * 50,
        [os.urandom(1000)],
        [os.urandom(1_000_000)],
        [b"{" * 60_000],
        [b'{"v":2,"id":1,"op":"status"}'],
        [b"", b'{"v":2,"id":1,"op":"controllers"}'],
        [b'{"v":2,"id":1,"op":"set-controller","args":{"name":"swing","parameters":{"C":0.5}}}'],
        [b'{"v":2,"id":1,"op":"set-controller","args":{"name":"nobody"}}'],
    ]
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with context.socket(zmq.DEALER) as socket:
            socket.set(zmq.LINGER, 0)
            socket.connect(daemon.endpoint)
            for _ in range(20):
                for frames in garbage:
                    try:
                        socket.send_multipart(frames, zmq.DONTWAIT)
                    except zmq.Again:
                        break
            socket.send(b"half a message", zmq.SNDMORE | zmq.DONTWAIT)
    context.destroy(linger=0)


def test_a_fishd_that_goes_on_after_a_hang_begins_nothing_of_before(own_daemon: Daemon) -> None:
    own_daemon.stop()
    with own_daemon.socket() as socket:
        swing = {"v": 2, "id": 1, "op": "set-controller", "args": {"name": "swing"}}
        socket.send(msgspec.json.encode(swing))
        socket.send(b'{"v":2,"id":2,"op":"stop"}')
        # Their age counts from when the gateway has taken them: what it answers itself comes next.
        assert ask(socket, b'{"v":3,"id":3,"op":"status"}')["error"]["code"] == "version"
        time.sleep(MAX_WAIT_S + 0.5)
        own_daemon.process.send_signal(signal.SIGCONT)
        replies = {reply["id"]: reply for reply in (json.loads(socket.recv()) for _ in range(2))}
    assert replies[2]["ok"]
    assert replies[1]["error"]["code"] == "stale"
    assert "fishd stood still or was flooded; send it again" in replies[1]["error"]["message"]
    assert own_daemon.status().mode == "idle"
    assert own_daemon.fishctl("set-controller", "swing").returncode == 0


@pytest.mark.realtime
def test_a_flood_of_requests_and_garbage_costs_no_tick(own_daemon: Daemon) -> None:
    with Subscriber(own_daemon.telemetry, b"tick") as subscriber:
        before = subscriber.message()
        shooter = threading.Thread(target=shoot, args=(own_daemon, 2.4))
        shooter.start()
        while shooter.is_alive():
            during = subscriber.message()
        shooter.join(PATIENCE)
    assert during["missed_slots"] == before["missed_slots"]
    assert during["seq"] - before["seq"] >= 40
    wait_until(lambda: own_daemon.fishctl("status").returncode == 0)
    _, _, errors = own_daemon.end()
    assert "Traceback" not in errors


@pytest.mark.realtime
def test_a_subscriber_that_stops_reading_slows_no_tick(daemon: Daemon) -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    stalled = context.socket(zmq.SUB)
    stalled.set(zmq.RCVHWM, 1)
    stalled.set(zmq.RCVBUF, 1024)
    stalled.set(zmq.SUBSCRIBE, b"")
    stalled.connect(daemon.telemetry)
    with Subscriber(daemon.telemetry, b"tick") as healthy:
        ticks = [healthy.message() for _ in range(60)]
    assert [t["seq"] for t in ticks] == list(range(ticks[0]["seq"], ticks[0]["seq"] + 60))
    assert ticks[-1]["missed_slots"] == ticks[0]["missed_slots"]
    context.destroy(linger=0)


def test_a_client_that_never_reads_its_answers_harms_nobody(daemon: Daemon) -> None:
    with daemon.socket() as deaf, daemon.socket() as healthy:
        deaf.set(zmq.RCVHWM, 1)
        for number in range(5000):
            deaf.send(msgspec.json.encode({"v": 2, "id": number, "op": "status"}))
        reply = ask(healthy, b'{"v":2,"id":5,"op":"stop"}')
    assert reply["ok"]
