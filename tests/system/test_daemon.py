"""The real daemon process: start, telemetry, signals, exit status."""

import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import get_type_hints

import msgspec
import pytest
from rigs.documents import ROOT
from rigs.processes import (
    FISHD,
    PATIENCE,
    Daemon,
    Subscriber,
    addresses,
    call,
    reserve_port,
    running,
    sets,
    wait_until,
)

from fishd.core.process.unix_sockets import is_deserted
from fishd.core.signals import Tick

SHIPPED = str(ROOT / "config" / "simulated.yaml")

EXTREMES = {"fx_min", "fx_max", "fy_min", "fy_max"}  # absent with a simulated fish
SWIMMER_FIELDS = {"x", "y", "speed", "heading"}
THRUST_FIELDS = {"thrust_ci95", "thrust_factor", "thrust_factor_ci95"}
"""Fields that are present after the first rest."""
OPTIONAL_FIELDS = THRUST_FIELDS | {"quantities", "readings", "leak", "fy_corrected", "suspect"}
"""Fields that are absent without a value."""
TICK_FIELDS = {
    name: kind if isinstance(kind, type) else float
    for name, kind in get_type_hints(Tick).items()
    if name not in EXTREMES | SWIMMER_FIELDS | OPTIONAL_FIELDS
}


def test_a_bare_subscriber_gets_two_frames_and_every_documented_field(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        for _ in range(5):
            topic, payload = subscriber.socket.recv_multipart()
            assert topic == b"tick"
            tick = msgspec.json.decode(payload)
            kinds = {name: type(x) for name, x in tick.items() if name not in OPTIONAL_FIELDS}
            assert kinds == TICK_FIELDS
            assert b"null" not in payload


@pytest.mark.realtime
def test_ticks_are_numbered_without_gaps_and_timed_without_drift(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        ticks = [subscriber.message() for _ in range(40)]
    assert [t["seq"] for t in ticks] == list(range(ticks[0]["seq"], ticks[0]["seq"] + 40))
    starts = [
        t["t"] - t["lateness_us"] * 1e-6 - (t["seq"] + t["missed_slots"]) * 0.05 for t in ticks
    ]
    # Each deadline is a whole number of periods after the first, within what a tick takes.
    assert max(starts) - min(starts) < 0.05


def test_the_three_topics_can_be_told_apart_by_prefix(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"status") as status:
        assert status.message()["robot"] == "simulated"
    with Subscriber(daemon.telemetry, b"event") as events:
        events.connected()
        daemon.fishctl("mark", "first")
        daemon.fishctl("mark", "second")
        assert events.until(kind="mark")["message"] in ("first", "second")


def test_a_mark_is_a_text_in_utf_8_whatever_the_locale(daemon: Daemon) -> None:
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    with Subscriber(daemon.telemetry, b"event") as events:
        events.connected()
        done = daemon.fishctl_apart("mark", "--json", "fin é", env=plain)
        assert done.returncode == 0, done.stderr
        mark = events.until(kind="mark")
    assert (mark["message"], mark["level"]) == ("fin é", "info")
    refused = daemon.fishctl_apart("mark", b"fin \xe9")  # type: ignore[arg-type]
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "'fin ?' is not a text in UTF-8" in refused.stderr


def test_the_shipped_configuration_rests_swims_and_says_so_every_second(tmp_path: Path) -> None:
    with running(tmp_path, "--config", SHIPPED, "--print-status") as daemon:
        with Subscriber(daemon.telemetry, b"tick") as subscriber:
            while subscriber.message()["frequency"] == 0.0:
                pass
        assert daemon.process.stdout is not None
        lines = [daemon.process.stdout.readline()]
        while "running swing" not in lines[-1]:
            assert lines[-1], "it has ended"
            lines.append(daemon.process.stdout.readline())
    assert all("idle" in line for line in lines[:3])
    for word in ("Hz", "thrust", "mN", "late", "missed"):
        assert word in lines[-1]


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_fades_to_neutral_and_exits_with_0(tmp_path: Path, number: int) -> None:
    with running(tmp_path, "--config", SHIPPED, *sets("start.rest=0.5")) as daemon:
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


def read_start_error(folder: Path, *settings: str) -> str:
    """Return the error messages of a fishd that cannot start with these settings."""
    status, out, errors = Daemon(folder, *sets(*settings)).finish()
    assert (status, out) == (1, "")
    assert "Traceback" not in errors
    return errors


def test_a_bad_configuration_exits_with_78_and_one_line(tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("plant:\n  omega: 12\n")
    status, out, errors = Daemon(tmp_path, "--config", str(file)).finish()
    assert (status, out) == (78, "")
    assert errors == f"fishd: {file}:2: plant.omega: unknown key; did you mean 'omega0'?\n"


def test_a_second_daemon_on_the_same_address_exits(tmp_path: Path, daemon: Daemon) -> None:
    with running(tmp_path, *sets(f"telemetry.address=ipc://{tmp_path}/telemetry")) as first:
        rival = f"another fishd (pid {first.process.pid}) already serves"
        assert f"{rival} {first.endpoint}" in read_start_error(tmp_path)
        (tmp_path / "other").mkdir()
        same = f"telemetry.address={first.telemetry}"
        assert f"{rival} {first.telemetry}" in read_start_error(tmp_path / "other", same)
        assert first.fishctl("status").returncode == 0
    assert not (tmp_path / "telemetry").exists()
    assert not (tmp_path / "control").exists()
    tcp = daemon.telemetry
    host, _, port = tcp.rpartition(":")
    line = read_start_error(tmp_path, f"telemetry.address={tcp}")
    assert f"telemetry.address: cannot listen on {tcp}: it is in use" in line
    assert line.endswith(f" --set telemetry.address={host}:{int(port) + 1}\n")


@pytest.mark.parametrize("host", ["nohost.invalid", "192.0.2.1"])  # reserved for examples
def test_a_telemetry_address_elsewhere_is_one_line_of_advice(tmp_path: Path, host: str) -> None:
    assert (
        f"telemetry.address: cannot listen on tcp://{host}:9872: {host} is not an address of this "
        "machine; write tcp://127.0.0.1:9872, or tcp://0.0.0.0:9872 for all\n"
    ) in read_start_error(tmp_path, f"telemetry.address=tcp://{host}:9872")


@pytest.mark.parametrize("key", ["control", "telemetry"])
def test_a_file_that_is_no_socket_is_left_alone(tmp_path: Path, key: str) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("data")
    errors = read_start_error(tmp_path, f"{key}.address=ipc://{precious}")
    assert f"{precious} exists and is not a socket" in errors
    assert precious.read_text() == "data"


def test_after_a_kill_a_client_knows_at_once_that_nobody_is_there(tmp_path: Path) -> None:
    with running(tmp_path) as daemon:
        daemon.kill()
        assert (tmp_path / "control").exists()
        wait_until(lambda: is_deserted(tmp_path / "control"))  # its gateways end shortly after it
        done = daemon.fishctl("status")
    assert (done.returncode, done.stderr) == (
        1,
        f"fishctl: no fishd at {daemon.endpoint}: no process listens there; start one with "
        "'fishd', or a simulated fish that swims with 'make run'; or name another with "
        "--endpoint or $FISHD_ENDPOINT\n",
    )


def test_after_a_kill_the_next_daemon_takes_the_place_over_without_a_pause(tmp_path: Path) -> None:
    with reserve_port() as reserved:
        telemetry = f"tcp://127.0.0.1:{reserved.getsockname()[1]}"
        for _ in range(3):
            with running(tmp_path, *sets(f"telemetry.address={telemetry}")) as daemon:
                assert daemon.fishctl("status").returncode == 0
                assert daemon.telemetry == telemetry
                daemon.kill()


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
        assert not daemon.status().realtime
        status, _, errors = daemon.end()
    assert status == 0
    assert errors.count("fishd.core.process.realtime") == 1
    assert "memory is not locked" in errors
    assert "no real-time scheduling" in errors
    assert "; run as the systemd service, or set realtime.priority: 0 and " in errors


ABOVE = """
import logging, os, resource
from fishd.core.process import realtime

def forbid(*_):
    raise PermissionError(1, "Operation not permitted")

os.sched_setscheduler = forbid
resource.getrlimit = lambda _: (51, 51)
logging.basicConfig()
assert not realtime.enter(60, False)
"""
"""Program with LimitRTPRIO=51, emulated, as not every machine lets a test raise that limit."""


def test_a_priority_above_what_is_permitted_is_told_with_the_limit() -> None:
    message = call(sys.executable, "-c", ABOVE).stderr
    assert "; let LimitRTPRIO= of its service be 61, not 51, or set realtime.priority: 0" in message


def test_what_is_not_asked_for_is_not_missed(tmp_path: Path) -> None:
    modest = sets("realtime.priority=0", "realtime.lock_memory=false")
    with running(tmp_path, *modest) as daemon:
        assert not daemon.status().realtime
        assert "fishd.core.process.realtime" not in daemon.end()[2]


@pytest.mark.realtime
@pytest.mark.parametrize("delay", [0, 0.1, 0.25, 0.4, 0.55])
def test_a_ctrl_c_at_any_moment_of_the_start_ends_it_without_a_traceback_or_a_beat(
    tmp_path: Path, delay: float
) -> None:
    process = subprocess.Popen(
        [FISHD, "--config", SHIPPED, *addresses(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPROFILEIMPORTTIME": "1"},
    )
    assert process.stderr
    for line in process.stderr:  # before its first module, Python itself would print a traceback
        if line.endswith(" fishd.daemon\n"):
            break
    time.sleep(delay)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode in (0, 130, -signal.SIGINT)
    assert "Traceback" not in errors
