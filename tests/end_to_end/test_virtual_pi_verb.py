"""The verb that runs a virtual Pi as a process of its own, and those that break it."""

import contextlib
import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import FISHCTL, PATIENCE

from fishd.emulation.i2c import Read, Write
from fishd.emulation.link import RemotePi
from fishd.hardware.pigpio_client import Client

CONFIG = [Write(b"\x01"), Read(2)]


class Process:
    """A running `fishctl virtual-pi run` with addresses of its own."""

    def __init__(self, folder: Path, *settings: str) -> None:
        self.path = folder / "pi"
        own = (f"virtual_pi.socket={self.path}", "virtual_pi.pigpio_port=0", *settings)
        self.options = [word for setting in own for word in ("--set", setting)]
        self.process = subprocess.Popen(
            [FISHCTL, "virtual-pi", "run", *self.options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_until_up(self) -> "Process":
        assert self.process.stdout
        self.greeting = self.process.stdout.readline()
        found = re.search(r"pigpiod on 127.0.0.1:(\d+)", self.greeting)
        assert found, self.end()
        self.port = int(found[1])
        return self

    def fishctl(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return fishctl(*arguments, *self.options)

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.end_by_itself()

    def end_by_itself(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err


def fishctl(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [FISHCTL, "virtual-pi", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
    )


@contextlib.contextmanager
def running(folder: Path, *settings: str) -> Iterator[Process]:
    process = Process(folder, *settings)
    try:
        yield process.wait_until_up()
    finally:
        process.end()


@pytest.fixture
def pi(tmp_path: Path) -> Iterator[Process]:
    with running(tmp_path, "panel.estop_gpio=17") as found:
        yield found


def test_it_says_where_it_listens_and_answers_there(pi: Process) -> None:
    assert pi.greeting == (
        f"virtual Pi on {pi.path}: ADS1115 0x48 on I2C bus 1, "
        f"pigpiod on 127.0.0.1:{pi.port} with the servo on GPIO 18\n"
    )
    with RemotePi(pi.path) as remote:
        assert remote.transfer(0x48, CONFIG) == [b"\x85\x83"]
    status = json.loads(pi.fishctl("status", "--json").stdout)
    assert status["pigpio_port"] == pi.port
    assert (status["pulse"], status["angle"], status["faults"]) == (0.0, None, {})


def test_a_pulse_moves_the_fish(pi: Process) -> None:
    client = Client("127.0.0.1", pi.port, PATIENCE)
    with contextlib.closing(client):
        client.set_servo_pulsewidth(18, 1740)
    deadline = time.monotonic() + PATIENCE
    with RemotePi(pi.path) as remote:  # nobody reads the sensor, and still the fish swims
        while remote.state().truth.alpha < 0.15 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert remote.state().truth.alpha > 0.15
    text = pi.fishctl("status").stdout
    assert "pulses      1740 µs, +0.400 rad" in text
    assert f"pigpiod     127.0.0.1:{pi.port}" in text


def test_faults_are_injected_shown_and_cleared(pi: Process) -> None:
    done = pi.fishctl("inject", "nack")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert pi.fishctl("inject", "stuck-busy", "--seconds", "60").returncode == 0
    assert re.search(r"faults +nack, stuck-busy \(\d+\.\d s left\)", pi.fishctl("status").stdout)
    with RemotePi(pi.path) as remote, pytest.raises(OSError, match="Remote I/O error"):
        remote.transfer(0x48, CONFIG)
    assert pi.fishctl("clear", "nack").returncode == 0
    assert list(json.loads(pi.fishctl("status", "--json").stdout)["faults"]) == ["stuck-busy"]
    assert pi.fishctl("clear").returncode == 0
    assert "faults      none" in pi.fishctl("status").stdout


def test_a_fault_that_nobody_knows_is_one_line_and_exit_2(pi: Process) -> None:
    done = pi.fishctl("inject", "nak")
    assert done.returncode == 2
    assert done.stderr == "fishctl: no fault is called 'nak'; did you mean 'nack'?\n"
    done = pi.fishctl("inject", "brown-out", "--seconds", "1")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_the_faults_are_listed_without_a_virtual_pi() -> None:
    text = fishctl("faults").stdout
    assert "pigpiod-frozen    pigpiod: stopped" in text
    assert "nack" in json.loads(fishctl("faults", "--json").stdout)


def test_the_button_of_the_configuration_is_pressed_and_let_go(pi: Process) -> None:
    assert pi.fishctl("press").returncode == 0
    with RemotePi(pi.path) as remote:
        assert remote.state().levels == {17: 1}
        assert pi.fishctl("unpress").returncode == 0
        assert remote.state().levels == {17: 0}
        done = fishctl("press", "--set", f"virtual_pi.socket={pi.path}")
    assert done.returncode == 1
    assert "panel.estop_gpio is null" in done.stderr


def test_without_a_virtual_pi_it_says_how_to_start_one(tmp_path: Path) -> None:
    done = fishctl("status", "--set", f"virtual_pi.socket={tmp_path}/pi")
    assert done.returncode == 1
    assert done.stderr == (
        f"fishctl: no virtual Pi is running at {tmp_path}/pi; "
        "start one with 'fishctl virtual-pi run'\n"
    )


def test_a_second_one_on_the_same_socket_is_refused(pi: Process) -> None:
    code, _, err = Process(pi.path.parent).end_by_itself()
    assert code == 1
    assert f"another virtual Pi (pid {pi.process.pid}) already listens on {pi.path}" in err
    assert err.count("\n") == 1
    assert pi.fishctl("status").returncode == 0


def test_a_port_that_is_taken_is_one_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, _, err = Process(tmp_path, f"virtual_pi.pigpio_port={port}").end_by_itself()
    assert code == 1
    assert err.startswith(f"fishctl: virtual_pi.pigpio_port: cannot listen on port {port}: ")
    assert err.count("\n") == 1


def test_a_wrong_configuration_is_exit_78(tmp_path: Path) -> None:
    code, _, err = Process(tmp_path, "virtual_pi.bus_sped=1").end_by_itself()
    assert code == 78
    assert "did you mean 'bus_speed'?" in err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly(tmp_path: Path, number: int) -> None:
    with running(tmp_path) as pi, RemotePi(pi.path):
        code, _, err = pi.end(number)
        assert (code, err) == (0, "")
        assert not pi.path.exists()


def test_one_that_was_killed_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    with running(tmp_path) as killed:
        remote = RemotePi(killed.path)
        killed.end(signal.SIGKILL)
        assert killed.path.exists()
    with contextlib.closing(remote):
        with pytest.raises(OSError, match="is gone"):
            remote.transfer(0x48, CONFIG)
        with running(tmp_path):
            assert remote.transfer(0x48, CONFIG) == [b"\x85\x83"]


def test_one_that_hangs_costs_a_time_out_and_its_late_answer_confuses_nobody(pi: Process) -> None:
    with RemotePi(pi.path) as remote:
        remote.set_timeout(0.01)
        pi.process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(TimeoutError, match="does not answer"):
                remote.transfer(0x48, [Write(b"\x02"), Read(2)])
            done = pi.fishctl("status")
        finally:
            pi.process.send_signal(signal.SIGCONT)
        assert done.stderr == (
            f"fishctl: the virtual Pi at {pi.path} does not answer: "
            "is 'fishctl virtual-pi run' still running?\n"
        )
        assert remote.transfer(0x48, CONFIG) == [b"\x85\x83"]


def test_what_a_stopped_virtual_pi_was_asked_in_vain_is_not_done_later(pi: Process) -> None:
    pi.process.send_signal(signal.SIGSTOP)
    try:
        asked = pi.fishctl("inject", "nack")
    finally:
        pi.process.send_signal(signal.SIGCONT)
    assert asked.returncode == 1
    assert "does not answer" in asked.stderr
    assert pi.fishctl("inject", "clipped").returncode == 0  # and nothing before it is left
    time.sleep(0.2)
    assert list(json.loads(pi.fishctl("status", "--json").stdout)["faults"]) == ["clipped"]
