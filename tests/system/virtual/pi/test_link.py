"""A virtual Pi behind its socket: transfers, errors, and recovery."""

import contextlib
import errno
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import PATIENCE

from fishd.core.clock import VirtualClock
from fishd.core.errors import StartupError
from fishd.hardware.force_sensor.ads1115 import Ads1115, Ads1115Settings
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi import link as pi_link
from fishd.virtual.pi.gpiochip import Pins
from fishd.virtual.pi.i2c import Read, Write, kernel_error
from fishd.virtual.pi.link import RemotePi
from fishd.virtual.pi.link_server import LinkServer
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.pi.wires import Wires
from fishd.virtual.plant.parameters import PlantParameters

ADDRESS = 0x48
CONFIG = [Write(b"\x01"), Read(2)]


def virtual_pi() -> VirtualPi:
    """Return a virtual Pi on a virtual clock, so that the bus takes no time."""
    settings = VirtualPiSettings(pigpio_port=0)
    return VirtualPi(settings, PlantParameters(), SimulationSettings(), 0.05, VirtualClock())


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients wait for an answer, so that a busy machine fails no test."""
    monkeypatch.setattr(pi_link, "ANSWER_MARGIN_S", PATIENCE)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pi"


@pytest.fixture
def pi(path: Path) -> Iterator[VirtualPi]:
    pi = virtual_pi()
    with LinkServer(pi, path):
        yield pi


def wait_until_equal(events: list[object], wanted: object) -> None:
    deadline = time.monotonic() + PATIENCE
    while events[-1:] != [wanted] and time.monotonic() < deadline:
        time.sleep(0.005)
    assert events[-1:] == [wanted]


def test_a_transfer_over_the_link_is_one_on_the_bus(pi: VirtualPi, path: Path) -> None:
    with RemotePi(path) as remote:
        assert path.stat().st_mode & 0o077 == 0, "for this user alone"
        assert remote.transfer(ADDRESS, [Write(b"\x02\x12\x34")]) == []
        deeds = [Write(b"\x02"), Read(2), Read(1)]
        assert remote.transfer(ADDRESS, deeds) == [b"\x12\x34", b"\x12"]
        assert pi.bus.transfer(ADDRESS, [Write(b"\x02"), Read(2)]) == [b"\x12\x34"]


def test_errors_of_the_bus_arrive_as_they_are(pi: VirtualPi, path: Path) -> None:
    with RemotePi(path) as remote:
        remote.inject("arbitration-lost", 60.0)
        assert remote.state().faults == {"arbitration-lost": pytest.approx(60.0, abs=1.0)}
        with pytest.raises(BlockingIOError) as caught:
            remote.transfer(ADDRESS, CONFIG)
        assert caught.value.errno == errno.EAGAIN
        remote.clear("arbitration-lost")
        assert remote.transfer(ADDRESS, CONFIG) == [b"\x85\x83"]


def test_bytes_that_are_no_request_do_no_harm(pi: VirtualPi, path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as raw, RemotePi(path) as remote:
        raw.connect(str(path))
        for nonsense in (b"\xff", b"hello", b"\x91\xa8Transfer", os.urandom(3000)):
            raw.send(nonsense)
            assert b"Failed" in raw.recv(65536)
        raw.send(b"\xff")
        raw.close()  # without taking the reply
        assert remote.transfer(ADDRESS, CONFIG) == [b"\x85\x83"]


def test_a_button_reaches_the_pins_of_another_process(pi: VirtualPi, path: Path) -> None:
    pi.set_level(4, 1)
    pins, seen = Pins(), list[object]()

    def set_level(gpio: int, level: int | None) -> None:
        pins.set_level(gpio, level)
        seen.append((gpio, level))

    wires = Wires(path, set_level)
    with contextlib.closing(wires):
        assert seen == [(4, 1)]
        pi.set_level(17, 1)
        wait_until_equal(seen, (17, 1))
        assert pins.lines[17].level() == 1
        pi.set_level(17, None)
        wait_until_equal(seen, (17, None))
        assert pins.lines[17].level() == 0
    wires.close()


def test_a_button_is_found_again_when_the_virtual_pi_was_restarted(path: Path) -> None:
    seen: list[object] = []
    first, second = virtual_pi(), virtual_pi()
    with LinkServer(first, path):
        wires = Wires(path, lambda *level: seen.append(level))
    with contextlib.closing(wires), LinkServer(second, path):
        second.set_level(17, 1)
        wait_until_equal(seen, (17, 1))


def test_a_virtual_pi_that_goes_away_is_no_device_until_it_is_back(path: Path) -> None:
    first, second = virtual_pi(), virtual_pi()
    with LinkServer(first, path):
        remote = RemotePi(path)
        remote.set_timeout(0.03)
        assert first.bus.timeout == 0.03
        remote.transfer(ADDRESS, CONFIG)
    with contextlib.closing(remote):
        for _ in range(3):
            with pytest.raises(OSError, match=r"the virtual Pi at .* is gone") as caught:
                remote.transfer(ADDRESS, CONFIG)
            assert caught.value.errno == errno.ENODEV
        with LinkServer(second, path):
            assert remote.transfer(ADDRESS, CONFIG) == [b"\x85\x83"]
            assert second.bus.timeout == 0.03


def test_a_second_virtual_pi_harms_no_first_one(pi: VirtualPi, path: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(path)
    with RemotePi(path) as remote:
        for name in (path, link):
            wanted = rf"another virtual Pi \(pid {os.getpid()}\) already serves {path}"
            with pytest.raises(StartupError, match=wanted):
                LinkServer(virtual_pi(), name).start()
        assert remote.transfer(ADDRESS, CONFIG) == [b"\x85\x83"]
    with RemotePi(link) as remote:
        assert remote.transfer(ADDRESS, CONFIG) == [b"\x85\x83"]


def test_a_virtual_pi_that_hangs_is_not_taken_for_a_bus_that_does(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pi_link, "ANSWER_MARGIN_S", 0.1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()  # and never answer, as a process that is stopped
        with RemotePi(path) as remote, pytest.raises(TimeoutError) as caught:
            remote.transfer(ADDRESS, CONFIG)
        assert caught.value.errno == errno.ETIMEDOUT
        sensor = Ads1115(Ads1115Settings(), VirtualClock())
        assert sensor.explain(caught.value) == (
            f"the virtual Pi at {path} does not answer: is 'fishctl virtual-pi run' still running? "
            "(error 110)"
        )
        with pytest.raises(StartupError, match=r"does not answer: is 'fishctl virtual-pi run'"):
            Wires(path, lambda *_: None)
    assert "check SDA and SCL" in sensor.explain(kernel_error(errno.ETIMEDOUT))


def test_the_socket_file_of_a_dead_virtual_pi_is_taken_over(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(str(path))
    with pytest.raises(StartupError, match="no virtual Pi is running"):
        RemotePi(path)
    with LinkServer(virtual_pi(), path), RemotePi(path) as remote:
        assert remote.transfer(ADDRESS, CONFIG) == [b"\x85\x83"]
    assert not path.exists()


def test_a_path_that_is_no_good_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "notes"
    file.write_text("mine")
    with pytest.raises(StartupError, match="notes exists and is not a socket"):
        LinkServer(virtual_pi(), file).start()
    assert file.read_text() == "mine"
    with pytest.raises(StartupError, match="cannot be created: No such file or directory"):
        LinkServer(virtual_pi(), tmp_path / "nowhere" / "pi").start()
    with pytest.raises(StartupError, match="too long"):
        LinkServer(virtual_pi(), tmp_path / ("x" * 150)).start()


def test_closing_leaves_no_thread_and_no_file(path: Path) -> None:
    before = set(threading.enumerate())
    server = LinkServer(virtual_pi(), path)
    server.start()
    remotes = [RemotePi(path) for _ in range(5)]
    server.close()
    server.close()
    assert set(threading.enumerate()) <= before
    assert not path.exists()
    for remote in remotes:
        remote.close()
        remote.close()
