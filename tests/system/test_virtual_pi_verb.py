"""Verb that runs a virtual Pi in a separate process, and verbs that inject faults."""

import contextlib
import json
import re
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import PATIENCE, fishctl, wait_until
from rigs.virtual_pi_process import Pi, virtual_pi

from fishd.hardware.servo.pigpio_client import Client
from fishd.virtual.pi.i2c import Read, Write
from fishd.virtual.pi.link import RemotePi

CONFIG = [Write(b"\x01"), Read(2)]


@pytest.fixture
def own_pi(tmp_path: Path) -> Iterator[Pi]:
    """Virtual Pi for a test of its start, its pulses or its end."""
    with virtual_pi(tmp_path) as own:
        yield own


@pytest.fixture(scope="module")
def shared_pi(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pi]:
    with virtual_pi(tmp_path_factory.mktemp("pi")) as shared:
        yield shared


@pytest.fixture
def pi(shared_pi: Pi) -> Pi:
    """Virtual Pi for all tests of a module, without a fault."""
    shared_pi.control("clear")
    return shared_pi


def faults(pi: Pi) -> list[str]:
    return list(json.loads(pi.control("status", "--json"))["faults"])


def test_it_says_where_it_listens_and_answers_there(own_pi: Pi) -> None:
    assert own_pi.greeting == (
        f"virtual Pi on {own_pi.path}: ADS1115 0x48 on I2C bus 1, "
        f"pigpiod on 127.0.0.1:{own_pi.port} with the servo on GPIO 18\n"
    )
    with RemotePi(own_pi.path) as remote:
        assert remote.transfer(0x48, CONFIG) == [b"\x85\x83"]
    status = json.loads(own_pi.control("status", "--json"))
    assert status["pigpio_port"] == own_pi.port
    assert (status["pulse"], status["phi_c"], status["faults"]) == (0.0, None, {})


def test_a_pulse_moves_the_fish(own_pi: Pi) -> None:
    with contextlib.closing(Client("127.0.0.1", own_pi.port, PATIENCE)) as client:
        client.set_servo_pulsewidth(18, 1740)
    with RemotePi(own_pi.path) as remote:  # the fish swims even if no client reads the sensor
        wait_until(lambda: remote.state().truth.alpha > 0.15)
    text = own_pi.control("status")
    assert "pulses      1740 µs, +0.400 rad" in text
    assert f"pigpiod     127.0.0.1:{own_pi.port}" in text


def test_faults_are_injected_shown_and_cleared(pi: Pi) -> None:
    assert pi.control("inject", "nack") == ""
    pi.control("inject", "stuck-busy", "--seconds", "60")
    assert re.search(r"faults +nack, stuck-busy \(\d+\.\d s left\)", pi.control("status"))
    with RemotePi(pi.path) as remote, pytest.raises(OSError, match="Remote I/O error"):
        remote.transfer(0x48, CONFIG)
    pi.control("clear", "nack")
    assert faults(pi) == ["stuck-busy"]
    pi.control("clear")
    assert "faults      none" in pi.control("status")


def test_a_fault_that_nobody_knows_is_one_line_and_exit_2(pi: Pi) -> None:
    done = pi.fishctl("inject", "nak")
    assert done.returncode == 2
    assert done.stderr == "fishctl: no fault is called 'nak'; did you mean 'nack'?\n"
    done = pi.fishctl("inject", "brown-out", "--seconds", "1")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_the_faults_are_listed_without_a_virtual_pi() -> None:
    assert "pigpiod-frozen    pigpiod: stopped" in fishctl("virtual-pi", "faults").stdout
    assert "nack" in json.loads(fishctl("virtual-pi", "faults", "--json").stdout)


def test_the_button_of_the_configuration_is_pressed_and_let_go(pi: Pi) -> None:
    pi.control("press")
    with RemotePi(pi.path) as remote:
        assert remote.state().levels == {17: 1}
        pi.control("release-button")
        assert remote.state().levels == {17: 0}
    done = fishctl("virtual-pi", "press", "--set", f"virtual_pi.socket={pi.path}")
    assert done.returncode == 1
    assert "panel.estop_gpio is null" in done.stderr


def test_without_a_virtual_pi_it_says_how_to_start_one(tmp_path: Path) -> None:
    done = fishctl("virtual-pi", "status", "--set", f"virtual_pi.socket={tmp_path}/pi")
    assert done.returncode == 1
    assert done.stderr == (
        f"fishctl: no virtual Pi is running at {tmp_path}/pi; "
        "start one with 'fishctl virtual-pi run'\n"
    )


def test_a_second_one_on_the_same_socket_is_refused(pi: Pi) -> None:
    code, _, err = Pi(pi.folder).finish()
    assert code == 1
    assert f"another virtual Pi (pid {pi.process.pid}) already serves {pi.path}" in err
    assert err.count("\n") == 1
    pi.control("status")


def test_a_port_that_is_taken_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, _, err = Pi(tmp_path, f"virtual_pi.pigpio_port={port}").finish()
    assert code == 1
    assert err.startswith(f"fishctl: virtual_pi.pigpio_port: cannot listen on port {port}: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(own_pi: Pi, number: int) -> None:
    with RemotePi(own_pi.path):
        code, _, err = own_pi.end(number)
        assert (code, err) == (0, "")
        assert not own_pi.path.exists()


def test_one_that_was_killed_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    with virtual_pi(tmp_path) as killed:
        remote = RemotePi(killed.path)
        killed.end(signal.SIGKILL)
        assert killed.path.exists()
    with contextlib.closing(remote):
        with pytest.raises(OSError, match="is gone"):
            remote.transfer(0x48, CONFIG)
        with virtual_pi(tmp_path):
            assert remote.transfer(0x48, CONFIG) == [b"\x85\x83"]


@contextlib.contextmanager
def stopped(pi: Pi) -> Iterator[None]:
    pi.stop()
    try:
        yield
    finally:
        pi.process.send_signal(signal.SIGCONT)


def test_one_that_hangs_costs_a_time_out_and_its_late_answer_confuses_nobody(pi: Pi) -> None:
    with RemotePi(pi.path) as remote:
        remote.set_timeout(0.01)
        with stopped(pi):
            with pytest.raises(TimeoutError, match="does not answer"):
                remote.transfer(0x48, [Write(b"\x02"), Read(2)])
            done = pi.fishctl("status")
        assert done.stderr == (
            f"fishctl: the virtual Pi at {pi.path} does not answer: "
            "is 'fishctl virtual-pi run' still running?\n"
        )
        assert remote.transfer(0x48, CONFIG) == [b"\x85\x83"]


def test_what_a_stopped_virtual_pi_was_asked_in_vain_is_not_done_later(pi: Pi) -> None:
    with stopped(pi):
        asked = pi.fishctl("inject", "nack")
    assert asked.returncode == 1
    assert "does not answer" in asked.stderr
    pi.control("inject", "clipped")  # without the requests before it
    time.sleep(0.2)
    assert faults(pi) == ["clipped"]
