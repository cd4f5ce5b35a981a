"""The real daemon process: start, telemetry, signals, exit status."""

import json
import os
import signal
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
from processes import FISHCTL, FISHD, PATIENCE, Daemon, Subscriber, running

SHIPPED = str(Path(__file__).parents[2] / "config" / "simulated.yaml")

TICK_FIELDS = {
    "t": float,
    "seq": int,
    "mode": str,
    "controller": str,
    "fx": float,
    "fy": float,
    "fy_rate": float,
    "fin_velocity": float,
    "phi_c": float,
    "servo_on": bool,
    "thrust": float,
    "frequency": float,
    "samples": int,
    "age_ms": float,
    "lateness_us": float,
    "busy_us": float,
    "missed": int,
    "alpha": float,
    "alpha_rate": float,
    "phi": float,
}


def test_a_bare_subscriber_gets_two_frames_and_every_documented_field(idle_daemon: Daemon) -> None:
    with Subscriber(idle_daemon.telemetry, b"tick") as subscriber:
        for _ in range(5):
            topic, payload = subscriber.frames()
            assert topic == b"tick"
            tick = msgspec.json.decode(payload)
            assert {name: type(value) for name, value in tick.items()} == TICK_FIELDS
            assert b"null" not in payload


def test_ticks_are_numbered_without_gaps_and_timed_without_drift(idle_daemon: Daemon) -> None:
    with Subscriber(idle_daemon.telemetry, b"tick") as subscriber:
        ticks = [subscriber.message() for _ in range(40)]
    assert [t["seq"] for t in ticks] == list(range(ticks[0]["seq"], ticks[0]["seq"] + 40))
    starts = [t["t"] - t["lateness_us"] * 1e-6 - (t["seq"] + t["missed"]) * 0.05 for t in ticks]
    # Each deadline is a whole number of periods after the first, within what a tick takes.
    assert max(starts) - min(starts) < 0.05


def test_the_three_topics_can_be_told_apart_by_prefix(idle_daemon: Daemon) -> None:
    with Subscriber(idle_daemon.telemetry, b"status") as status:
        assert status.message()["robot"] == "simulated"
    with (
        Subscriber(idle_daemon.telemetry, b"event") as events,
        Subscriber(idle_daemon.telemetry) as every,
    ):
        every.message()  # connected
        idle_daemon.fishctl("mark", "first")
        idle_daemon.fishctl("mark", "second")
        assert events.until(kind="mark")["message"] in ("first", "second")


def test_the_shipped_configuration_swims_at_once_and_says_so_every_second(tmp_path: Path) -> None:
    with running(tmp_path, "--config", SHIPPED, "--print-status") as daemon:
        with Subscriber(daemon.telemetry, b"tick") as subscriber:
            while subscriber.message()["frequency"] == 0.0:
                pass
        assert daemon.process.stdout is not None
        lines = [daemon.process.stdout.readline() for _ in range(3)]
    for word in ("running swing", "Hz", "thrust", "mN", "late", "missed"):
        assert word in lines[-1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_fades_to_neutral_and_exits_with_0(tmp_path: Path, number: int) -> None:
    with running(tmp_path, "--config", SHIPPED) as daemon:
        with Subscriber(daemon.telemetry, b"tick") as subscriber:
            subscriber.until(phi_c=0.42)
            daemon.process.send_signal(number)
            angles = [subscriber.until(mode="idle")["phi_c"]]
            while angles[-1] != 0.0:
                angles.append(subscriber.message()["phi_c"])
        steps = [abs(b - a) for a, b in pairwise(angles)]
        assert all(step <= 0.42 * 0.05 / 0.4 + 1e-6 for step in steps)
        status, _, errors = daemon.end(number)
    assert status == 0
    assert "Traceback" not in errors


def test_a_bad_configuration_exits_with_78_and_one_line(tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("plant:\n  omega: 12\n")
    status, out, errors = Daemon(tmp_path, "--config", str(file)).finish()
    assert (status, out) == (78, "")
    assert errors == f"fishd: {file}:2: plant.omega: unknown key; did you mean 'omega0'?\n"


def test_a_second_daemon_on_the_same_control_address_says_so_and_exits(idle_daemon: Daemon) -> None:
    folder = Path(idle_daemon.endpoint.removeprefix("ipc://")).parent
    second = Daemon(folder)
    status, _, errors = second.finish()
    assert status == 1
    assert (
        f"another fishd (pid {idle_daemon.process.pid}) already serves {idle_daemon.endpoint}"
        in errors
    )
    assert "Traceback" not in errors
    assert idle_daemon.fishctl("status").returncode == 0


def test_a_second_daemon_on_the_same_telemetry_address_says_so_and_exits(
    daemon: Daemon, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    second = Daemon(other, "--set", f"telemetry.address={daemon.telemetry}")
    status, _, errors = second.finish()
    assert status == 1
    assert f"telemetry.address: cannot listen on {daemon.telemetry}: it is in use" in errors
    assert "Traceback" not in errors


def test_a_telemetry_address_of_another_machine_is_one_line_with_what_would_be_right(
    tmp_path: Path,
) -> None:
    for host in ("nohost.invalid", "192.0.2.1"):  # which is nobody's
        status, _, errors = Daemon(
            tmp_path, "--set", f"telemetry.address=tcp://{host}:9872"
        ).finish()
        assert status == 1
        assert (
            f"telemetry.address: cannot listen on tcp://{host}:9872: {host} is no address of this "
            "machine; write tcp://127.0.0.1:9872, or tcp://0.0.0.0:9872 for all\n"
        ) in errors


def test_a_file_that_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("data")
    for key in ("control", "telemetry"):
        status, _, errors = Daemon(tmp_path, "--set", f"{key}.address=ipc://{precious}").finish()
        assert status == 1
        assert f"{precious} is there already and is no socket" in errors
        assert "Traceback" not in errors
    assert precious.read_text() == "data"


def test_a_second_daemon_on_the_same_telemetry_socket_says_so_and_exits(tmp_path: Path) -> None:
    address = ("--set", f"telemetry.address=ipc://{tmp_path}/telemetry")
    other = tmp_path / "other"
    other.mkdir()
    with running(tmp_path, *address) as first:
        status, _, errors = Daemon(other, *address).finish()
        assert status == 1
        assert f"another fishd (pid {first.process.pid}) already serves ipc://" in errors
    assert not (tmp_path / "telemetry").exists()


def test_after_its_end_nothing_is_left_to_connect_to(tmp_path: Path) -> None:
    with running(tmp_path) as daemon:
        assert daemon.end()[0] == 0
        assert not (tmp_path / "control").exists()


def test_after_a_kill_a_client_knows_at_once_that_nobody_is_there(tmp_path: Path) -> None:
    with running(tmp_path) as daemon:
        daemon.process.kill()
        daemon.process.wait()
        assert (tmp_path / "control").exists()
        assert "nobody listens there" in daemon.fishctl("status").stderr


def test_after_a_kill_the_next_daemon_takes_the_socket_over(tmp_path: Path) -> None:
    with running(tmp_path) as first:
        first.process.kill()
        first.process.wait()
    with running(tmp_path) as second:
        assert second.fishctl("status").returncode == 0


def test_logs_can_be_json(tmp_path: Path) -> None:
    with running(tmp_path, "--log-format", "json") as daemon:
        daemon.fishctl("mark", "hello")
        _, _, errors = daemon.end()
    entries = [json.loads(line) for line in errors.splitlines()]
    assert "mark: hello" in [entry["message"] for entry in entries]
    assert all({"t", "level", "logger", "message"} <= set(entry) for entry in entries)


def test_without_the_privilege_it_warns_once_and_goes_on(tmp_path: Path) -> None:
    unprivileged = ["prlimit", "--memlock=65536", "--rtprio=0"]
    if os.geteuid() == 0:
        unprivileged += ["setpriv", "--bounding-set=-sys_nice,-ipc_lock,-sys_resource"]
        unprivileged += ["--inh-caps=-sys_nice,-ipc_lock,-sys_resource"]
    with running(tmp_path, under=unprivileged) as daemon:
        assert json.loads(daemon.fishctl("status", "--json").stdout)["realtime"] is False
        status, _, errors = daemon.end()
    assert status == 0
    assert errors.count("warning") == 1
    assert "memory is not locked" in errors
    assert "no real-time scheduling" in errors


def test_what_is_not_asked_for_is_not_missed(tmp_path: Path) -> None:
    modest = ("--set", "realtime.priority=0", "--set", "realtime.lock_memory=false")
    with running(tmp_path, *modest) as daemon:
        assert json.loads(daemon.fishctl("status", "--json").stdout)["realtime"] is False
        _, _, errors = daemon.end()
    assert "warning" not in errors


def test_fishctl_says_when_no_daemon_is_there(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/nobody"
    command = [FISHCTL, "status", "--endpoint", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        f"fishctl: no fishd at {endpoint}: nobody listens there; start one with 'fishd', "
        "or name another with --endpoint or $FISHD_ENDPOINT\n"
    )


@pytest.mark.parametrize("delay", [0.05, 0.15, 0.3, 0.45, 0.6])
def test_a_ctrl_c_at_any_moment_of_the_start_ends_it_without_a_traceback_or_a_beat(
    tmp_path: Path, delay: float
) -> None:
    command = [FISHD, "--config", SHIPPED, "--set", f"control.address=ipc://{tmp_path}/control"]
    command += ["--set", "telemetry.address=tcp://127.0.0.1:0"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode in (0, 130, -signal.SIGINT)
    assert "Traceback" not in errors


def test_a_fishd_that_was_killed_is_followed_by_the_next_one_without_a_pause(
    tmp_path: Path,
) -> None:
    for _ in range(3):
        with running(tmp_path, "--set", "telemetry.address=tcp://127.0.0.1:0") as first:
            port = first.telemetry
            first.process.kill()
            first.process.wait()
            with running(tmp_path, "--set", f"telemetry.address={port}") as second:
                assert second.fishctl("status").returncode == 0
