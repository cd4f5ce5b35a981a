"""The gateway of a real fishd, which survives its failures."""

import asyncio
import contextlib
import json
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.documents import ROOT
from rigs.gateway_processes import gateway, gateways, gone
from rigs.processes import PATIENCE, Daemon, Process, Subscriber, call, running, wait_until

from fishd.client import AsyncFish, Fish
from fishd.daemon.gateway.gateways import RECONNECT_TIME_S

ATTACKERS = ROOT / "tests" / "rigs" / "attackers.py"


SWIMMING = ("--set", "start.controller=swing")


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    with running(tmp_path, *SWIMMING) as daemon:
        yield daemon


@pytest.fixture(scope="module")
def shared_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """Return a daemon that several tests share, and that swims through all of them."""
    with running(tmp_path_factory.mktemp("fishd"), *SWIMMING) as daemon:
        yield daemon


def restarts(daemon: Daemon) -> float:
    return daemon.status().recovered_errors.get("gateway_restarts", 0)


@pytest.mark.realtime
def test_a_gateway_that_dies_is_started_again_for_its_subscribers(shared_daemon: Daemon) -> None:
    before = restarts(shared_daemon)
    with Subscriber(shared_daemon.telemetry) as subscriber:
        missed = subscriber.until(mode="running")["missed_slots"]
        os.kill(gateway(shared_daemon), signal.SIGKILL)
        event = subscriber.until(kind="gateway")
        tick = subscriber.until(mode="running")
    expected = "the local gateway was started again: its process ended with status -9"
    assert event["message"] == expected
    assert tick["missed_slots"] == missed
    assert restarts(shared_daemon) == before + 1


@pytest.mark.realtime  # a subscriber has a second to connect again
def test_subscribers_hear_of_a_restart_however_long_the_new_gateway_takes(tmp_path: Path) -> None:
    """The gateway drops waiting messages if no subscriber has connected again."""
    slow = tmp_path / "slow"
    code = f"""
import pathlib, sys, time
if "fishd.daemon.gateway" in sys.orig_argv and pathlib.Path({str(slow)!r}).exists():
    time.sleep({1.5 * RECONNECT_TIME_S})
"""
    (tmp_path / "sitecustomize.py").write_text(code)
    variables = ("env", f"PYTHONPATH={tmp_path}:{ROOT}")
    with (
        running(tmp_path, under=variables) as daemon,
        Subscriber(daemon.telemetry, b"event") as subscriber,
    ):
        subscriber.connected()
        slow.touch()
        os.kill(gateway(daemon), signal.SIGKILL)
        assert "status -9" in subscriber.until(kind="gateway")["message"]
        # After exceeding a limit, the gateway starts again, and that is reported again.
        with attacking("idle-control", daemon):
            wait_until(lambda: restarts(daemon) >= 2)
        assert "connections" in subscriber.until(kind="gateway")["message"]


def test_while_the_gateway_hangs_a_stop_and_a_status_are_answered(daemon: Daemon) -> None:
    os.kill(gateway(daemon), signal.SIGSTOP)
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.status().mode == "running"
        assert fish.estop().mode == "estop"


def test_a_client_of_a_gateway_that_died_is_answered_by_the_next_one(shared_daemon: Daemon) -> None:
    before = restarts(shared_daemon)
    os.kill(gateway(shared_daemon), signal.SIGKILL)
    assert restarts(shared_daemon) == before + 1


def test_a_hanging_gateway_is_replaced_and_costs_no_tick(shared_daemon: Daemon) -> None:
    before = shared_daemon.status()
    hung = gateway(shared_daemon)
    with Subscriber(shared_daemon.telemetry, b"event") as subscriber:
        subscriber.connected()
        os.kill(hung, signal.SIGSTOP)
        assert gateway(shared_daemon, hung) != hung
        event = subscriber.until(kind="gateway")
        while "status -9" in event["message"]:  # of the restart in a test before, reported late
            event = subscriber.until(kind="gateway")
    assert re.search(r" was started again: it left \d+ heartbeats unanswered$", event["message"])
    wait_until(lambda: gone(hung))
    after = shared_daemon.status()
    errors = before.recovered_errors, after.recovered_errors
    assert errors[1]["gateway_restarts"] == errors[0].get("gateway_restarts", 0) + 1
    assert after.mode == "running"


def test_a_gateway_that_computes_without_end_is_replaced(tmp_path: Path) -> None:
    spin = tmp_path / "spin"
    code = f"""
import os, sys
if "fishd.daemon.gateway" in sys.orig_argv:
    from fishd.daemon.gateway.router import Router
    pass_on = Router.pass_on
    def spin(self):
        while os.path.exists({str(spin)!r}):
            pass
        pass_on(self)
    Router.pass_on = spin
"""
    (tmp_path / "sitecustomize.py").write_text(code)
    with running(tmp_path, under=("env", f"PYTHONPATH={tmp_path}:{ROOT}")) as daemon:
        spinning = gateway(daemon)
        spin.touch()
        assert gateway(daemon, spinning) != spinning
        wait_until(lambda: gone(spinning))
        spin.unlink()
        with Subscriber(daemon.telemetry, b"event") as subscriber:
            assert "heartbeats unanswered" in subscriber.until(kind="gateway")["message"]


def test_a_starved_gateway_is_kept_with_the_command_that_it_holds(daemon: Daemon) -> None:
    """A processor with a real-time task leaves 5 % to all other processes, once a second."""
    pid, processor = gateway(daemon), min(os.sched_getaffinity(0))
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.status()
        for thread in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setaffinity(int(thread.name), {processor})
        code = f"""
import os, time
os.sched_setaffinity(0, {{{processor}}})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
print("spins", flush=True)
end = time.monotonic() + 3.0
while time.monotonic() < end:
    pass
"""
        with Process(sys.executable, "-c", code) as spinner:
            if not spinner.process.stdout.readline():
                pytest.skip("no real-time priority is permitted here: run as root")
            while spinner.process.poll() is None:
                assert fish.mark("starved").mode == "running"
        assert fish.status().recovered_errors.get("gateway_restarts", 0) == 0
    assert gateway(daemon) == pid


def test_an_estop_is_answered_while_the_gateway_is_stopped(daemon: Daemon) -> None:
    os.kill(gateway(daemon), signal.SIGSTOP)
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.estop("from a test").mode == "estop"
        assert fish.estop_taken_by in ("estop", "control")
    assert daemon.status().reason.message == "from a test"  # type: ignore[union-attr]


def test_a_read_that_a_hanging_gateway_took_is_answered_by_the_next_one(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.status()
        os.kill(gateway(daemon), signal.SIGSTOP)
        assert fish.status().recovered_errors["gateway_restarts"] == 1


@pytest.mark.realtime
@pytest.mark.parametrize("connected", [False, True])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_an_estop_is_answered_within_a_fifth_of_a_second_after_any_single_failure(
    shared_daemon: Daemon, number: signal.Signals, connected: bool
) -> None:
    pid = gateway(shared_daemon)
    with Fish(shared_daemon.endpoint) as fish:
        if connected:
            fish.status()
        os.kill(pid, number)
        started = time.monotonic()
        fish.estop()
        assert time.monotonic() - started <= 0.2
    wait_until(lambda: gone(pid))
    with Fish(shared_daemon.endpoint, timeout=PATIENCE) as fish:
        fish.clear_fault()
        fish.set_controller("swing")


def test_an_asyncio_client_has_its_estop_answered_then_too(daemon: Daemon) -> None:
    async def stop() -> str:
        async with AsyncFish(daemon.endpoint, timeout=PATIENCE) as fish:
            return (await fish.estop()).mode

    os.kill(gateway(daemon), signal.SIGSTOP)
    assert asyncio.run(stop()) == "estop"


def test_the_socket_for_an_estop_takes_nothing_else(shared_daemon: Daemon) -> None:
    path = Path(shared_daemon.endpoint.removeprefix("ipc://") + ".estop")
    assert path.stat().st_mode & 0o777 == 0o660
    with shared_daemon.estop_socket() as client:
        for request, error in (
            (b'{"v":2,"id":1,"op":"clear-fault"}', "unknown-op"),
            (b"estop", "bad-request"),
            (bytes(2**16), "bad-request"),
        ):
            client.send(request)
            assert json.loads(client.recv(2**16))["error"]["code"] == error
    assert shared_daemon.status().mode == "running"


@pytest.mark.realtime
def test_a_fishd_whose_gateway_hangs_ends_in_time(daemon: Daemon) -> None:
    hung = gateway(daemon)
    os.kill(hung, signal.SIGSTOP)
    started = time.monotonic()
    assert daemon.end()[0] == 0
    assert time.monotonic() - started < 3.0
    wait_until(lambda: gone(hung))


def test_a_stopped_gateway_ends_with_a_fishd_that_is_killed(tmp_path: Path) -> None:
    """Check that its addresses are free for the next fishd."""
    with running(tmp_path, *SWIMMING) as daemon:
        pid = gateway(daemon)
        os.kill(pid, signal.SIGSTOP)
        daemon.process.kill()
        wait_until(lambda: gone(pid))
    with running(tmp_path, *SWIMMING) as daemon:
        assert daemon.status().mode == "running"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGTERM])
def test_no_gateway_outlives_fishd(daemon: Daemon, number: int) -> None:
    pid = gateway(daemon)
    daemon.end(number)
    wait_until(lambda: gone(pid))


@pytest.mark.realtime  # the time for the last messages is limited in real time
def test_a_signal_for_the_whole_group_leaves_the_gateway_to_fishd(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry) as subscriber:
        subscriber.until(mode="running")
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(gateway(daemon), number)
        daemon.process.send_signal(signal.SIGTERM)
        assert subscriber.until(kind="mode")["message"] == "running → idle"


def attacker(name: str, daemon: Daemon, seconds: float) -> list[str]:
    """Return the command that attacks a fishd for `seconds`."""
    addresses = (daemon.telemetry, daemon.endpoint)
    return [sys.executable, str(ATTACKERS), name, *addresses, str(seconds)]


def attack(name: str, daemon: Daemon, seconds: float) -> None:
    call(*attacker(name, daemon, seconds), check=True, timeout=3 * PATIENCE)


def attacking(name: str, daemon: Daemon) -> Process:
    """Return a context manager: an attack that lasts until the context is left."""
    return Process(*attacker(name, daemon, PATIENCE))


def memory(daemon: Daemon) -> float:
    """Return the memory of fishd and its gateway, with shared pages counted once [MB]."""
    total = 0
    for pid in (daemon.process.pid, gateway(daemon)):
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / 1024


@pytest.mark.realtime
def test_a_hundred_thousand_subscriptions_that_leave_cost_no_tick(shared_daemon: Daemon) -> None:
    before = shared_daemon.status()
    attack("subscriptions", shared_daemon, 4.0)
    after = shared_daemon.status()
    assert (after.mode, after.missed_slots) == ("running", before.missed_slots)
    assert memory(shared_daemon) < 150.0
    with Subscriber(shared_daemon.telemetry, b"tick") as subscriber:
        assert subscriber.message()["mode"] == "running"


def test_a_frame_that_announces_8_gb_ends_its_connection(shared_daemon: Daemon) -> None:
    host, _, port = shared_daemon.telemetry.removeprefix("tcp://").rpartition(":")
    with socket.create_connection((host, int(port)), PATIENCE) as connection:
        greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + b"\x00" + bytes(31)
        connection.sendall(greeting + b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB")
        connection.sendall(b"\x02" + (8 * 2**30).to_bytes(8, "big"))
        with contextlib.suppress(ConnectionError):
            while connection.recv(4096):
                pass
    assert shared_daemon.status().mode == "running"


@pytest.mark.realtime
def test_a_thousand_idle_connections_end_nothing(tmp_path: Path) -> None:
    few_files = ("prlimit", "--nofile=1024")
    with running(tmp_path, "--set", "start.controller=swing", under=few_files) as daemon:
        before = daemon.status()
        attack("idle-telemetry", daemon, 3.0)
        after = daemon.status()
        assert (after.mode, after.missed_slots) == ("running", before.missed_slots)
        with Subscriber(daemon.telemetry, b"tick") as subscriber:
            assert subscriber.message()["mode"] == "running"


def test_an_estop_overtakes_the_requests_of_500_clients_that_never_read(daemon: Daemon) -> None:
    path = daemon.endpoint.removeprefix("ipc://")
    with attacking("silent-dealers", daemon) as clients:
        wait_until(lambda: Path("/proc/net/unix").read_text().count(path) > 500)
        time.sleep(1.0)  # lets each fill its queue
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            assert fish.estop().mode == "estop"
        assert clients.process.poll() is None
        assert memory(daemon) < 150.0


def test_a_client_that_asks_too_fast_is_told_so_and_others_are_not(shared_daemon: Daemon) -> None:
    with shared_daemon.socket() as hasty, Fish(shared_daemon.endpoint, timeout=PATIENCE) as calm:
        shared_daemon.stop()
        try:
            for number in range(1500):
                hasty.send(b'{"v":2,"id":%d,"op":"config"}' % number)
            reply = json.loads(hasty.recv())  # while fishd answers nothing
        finally:
            shared_daemon.process.send_signal(signal.SIGCONT)
        assert calm.status().mode == "running"
    assert reply["error"]["code"] == "busy"
    assert "of your requests are already waiting; slow down" in reply["error"]["message"]


@pytest.mark.realtime
def test_a_client_that_asks_again_after_each_answer_is_not_refused(shared_daemon: Daemon) -> None:
    with Fish(shared_daemon.endpoint, timeout=PATIENCE) as fish:
        missed = fish.status().missed_slots
        for _ in range(500):
            assert fish.status().missed_slots == missed


def test_a_long_name_of_an_operation_is_refused_with_no_suggestion(shared_daemon: Daemon) -> None:
    with shared_daemon.socket() as client:
        client.send(b'{"v":2,"id":1,"op":"%s"}' % (b"x" * 16_000))
        error = json.loads(client.recv())["error"]
    assert error["code"] == "bad-request"
    assert "length <= 64" in error["message"]
    assert len(error["message"]) < 200


def test_replies_too_long_for_the_link_arrive_whole_and_hold_up_no_estop(tmp_path: Path) -> None:
    folder = tmp_path / "policies"
    folder.mkdir()
    shipped = ROOT / "config" / "policies" / "default-fish.onnx"
    for number in range(150):  # 339 kB; there is room for 213
        (folder / f"copy{number}.onnx").symlink_to(shipped)
    variables = ("env", f"FISHD_POLICIES={folder}")
    with running(tmp_path, under=variables) as daemon, Fish(daemon.endpoint, timeout=60) as fish:
        for _ in range(2):
            names = [policy.name for policy in fish.policies()]
            assert len([name for name in names if name.startswith("copy")]) == 150
        assert fish.estop().mode == "estop"


def test_a_reply_that_nobody_waits_for_any_more_reaches_no_other_client(tmp_path: Path) -> None:
    with running(tmp_path) as daemon, daemon.socket() as before:
        for _ in range(4):
            before.send(b'{"v":2,"id":"before","op":"policies"}')
        killed = gateway(daemon)
        os.kill(killed, signal.SIGKILL)
        assert gateway(daemon, killed) != killed
        with daemon.socket() as after:
            for number in range(50):
                after.send(b'{"v":2,"id":%d,"op":"status"}' % number)
                assert json.loads(after.recv())["id"] == number
        assert daemon.status().recovered_errors["gateway_restarts"] == 1


@pytest.mark.realtime
def test_fishd_awaits_the_end_of_its_gateway_without_a_real_time_priority(daemon: Daemon) -> None:
    def policy() -> int:
        return os.sched_getscheduler(daemon.process.pid) & ~os.SCHED_RESET_ON_FORK

    if policy() != os.SCHED_FIFO:
        pytest.skip("no real-time priority is permitted here: run as root, or raise RLIMIT_RTPRIO")
    os.kill(gateway(daemon), signal.SIGSTOP)
    daemon.process.send_signal(signal.SIGTERM)
    policies = set()
    while daemon.process.poll() is None:
        policies.add(policy())
        time.sleep(0.02)
    assert os.SCHED_OTHER in policies
    assert daemon.process.returncode == 0


@pytest.mark.realtime
def test_a_gateway_that_had_too_many_connections_begins_anew_without_a_leak(daemon: Daemon) -> None:
    pid = daemon.process.pid
    open_files = []
    missed = daemon.status().missed_slots
    for count in (1, 2):
        with attacking("idle-control", daemon):
            wait_until(lambda count=count: restarts(daemon) >= count)
        with Subscriber(daemon.telemetry, b"tick") as subscriber:
            assert subscriber.message()["missed_slots"] == missed
        open_files.append(len(list(Path(f"/proc/{pid}/fd").iterdir())))
    assert open_files[1] <= open_files[0] + 1


@pytest.mark.realtime  # as above
def test_a_gateway_that_dies_again_and_again_is_reported_all_the_same(daemon: Daemon) -> None:
    killed = set()
    end = time.monotonic() + 2.5
    with Subscriber(daemon.telemetry, b"event") as subscriber:
        while time.monotonic() < end or len(killed) < 3:
            for pid in set(gateways(daemon)) - killed:
                os.kill(pid, signal.SIGKILL)
                killed.add(pid)
            time.sleep(0.01)
        wait_until(lambda: daemon.status().recovered_errors["gateway_restarts"] >= len(killed))
        subscriber.until(kind="gateway")
    _, _, errors = daemon.end()
    assert "the local gateway was started again: its process ended with status -9" in errors


def nice(pid: int) -> int:
    return os.getpriority(os.PRIO_PROCESS, pid)


@pytest.mark.parametrize("more", [3, -9])
def test_the_gateway_stands_back_behind_fishd(tmp_path: Path, more: int) -> None:
    with running(tmp_path, under=("nice", "-n", str(more))) as daemon:  # or, if forbidden, at 0
        wait_until(lambda: nice(gateway(daemon)) == nice(daemon.process.pid) + 5)
