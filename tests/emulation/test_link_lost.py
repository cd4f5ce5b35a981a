"""What is said of a virtual Pi that hangs or is gone: not what a bus that does so would get."""

import contextlib
import errno
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from fishd.clock import VirtualClock
from fishd.emulation.i2c import Read, Write, kernel_error
from fishd.emulation.link import RemotePi
from fishd.emulation.link_server import LinkServer
from fishd.emulation.linux_i2c import LinuxI2c
from fishd.emulation.settings import VirtualPiSettings
from fishd.emulation.virtual_pi import VirtualPi
from fishd.emulation.wires import Wires
from fishd.errors import StartupError
from fishd.hardware.i2c_errors import explain
from fishd.hardware.imperfections import SimulationSettings
from fishd.hardware.sampler import Sampler
from fishd.hardware.settings import ForceSensorSettings
from fishd.plant.parameters import PlantParameters

ADDRESS = 0x48
CONFIG = [Write(b"\x01"), Read(2)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "pi"


@pytest.fixture
def mute(path: Path) -> Iterator[None]:
    """A virtual Pi that takes requests and never answers, as one that is stopped."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
        listener.listen()
        yield


def test_a_virtual_pi_that_hangs_is_not_taken_for_a_bus_that_does(mute: None, path: Path) -> None:
    with RemotePi(path) as remote:
        with pytest.raises(TimeoutError) as caught:
            remote.transfer(ADDRESS, CONFIG)
        assert caught.value.errno == errno.ETIMEDOUT
        assert explain(caught.value, 1, ADDRESS) == (
            f"the virtual Pi at {path} does not answer: is 'fishctl virtual-pi run' still running? "
            "(error 110)"
        )
    assert "check SDA and SCL" in explain(kernel_error(errno.ETIMEDOUT), 1, ADDRESS)


def test_the_force_sensor_says_that_the_virtual_pi_is_gone(path: Path) -> None:
    settings = VirtualPiSettings(pigpio_port=0)
    pi = VirtualPi(settings, PlantParameters(), SimulationSettings(), 0.05, VirtualClock())
    with LinkServer(pi, path):
        remote = RemotePi(path)
    with contextlib.closing(remote), LinuxI2c(remote.transfer, {205}, remote.set_timeout):
        sampler = Sampler(ForceSensorSettings(bus=205), VirtualClock())
        sampler.step()
        sampler.close()
    assert sampler.trouble == (
        f"the virtual Pi at {path} is gone: is 'fishctl virtual-pi run' still running? (error 19)"
    )


def test_pins_of_a_virtual_pi_that_hangs_are_one_line(mute: None, path: Path) -> None:
    with pytest.raises(StartupError, match=r"does not answer: is 'fishctl virtual-pi run'"):
        Wires(path, lambda *_: None)
