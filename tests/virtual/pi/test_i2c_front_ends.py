"""What the true drivers meet at the emulated /dev/i2c-N."""

import array
import errno
import fcntl
import os
import termios
from collections.abc import Iterator

import adafruit_extended_bus
import pytest
from adafruit_extended_bus import ExtendedI2C
from Adafruit_PureIO import smbus
from rigs.ads1115_board import ABSENT_BUS, Board

from fishd.virtual.pi.ads1115 import RESET_CONFIG, Ads1115Chip
from fishd.virtual.pi.linux_i2c import LinuxI2c

RESET_WORD = 0x8000 | RESET_CONFIG
I2C_TIMEOUT = 0x0702


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as board:
        yield board


@pytest.fixture
def pureio(board: Board) -> Iterator[smbus.SMBus]:
    with smbus.SMBus(ABSENT_BUS) as bus:
        yield bus


@pytest.mark.parametrize(
    ("fault", "number", "kind"),
    [
        ("nack", 121, OSError),
        ("timeout", 110, TimeoutError),
        ("clock-stretch", 5, OSError),
        ("bus-owned", 16, OSError),
        ("arbitration-lost", 11, BlockingIOError),
    ],
)
def test_errors_reach_the_driver_with_the_kernels_numbers_and_classes(
    board: Board, fault: str, number: int, kind: type[OSError]
) -> None:
    bus = ExtendedI2C(ABSENT_BUS, frequency=None)
    board.faults.inject(fault)
    for call in (
        lambda: bus.writeto(0x48, b"\x01"),
        lambda: bus.readfrom_into(0x48, bytearray(2)),
        lambda: bus.writeto_then_readfrom(0x48, b"\x01", bytearray(2)),
    ):
        with pytest.raises(OSError, match="Errno") as caught:
            call()
        assert (type(caught.value), caught.value.errno) == (kind, number)
    board.faults.clear()
    word = bytearray(2)
    bus.writeto_then_readfrom(0x48, b"\x01", word)
    assert word == RESET_WORD.to_bytes(2, "big")


def test_a_hanging_bus_costs_a_second_unless_the_kernel_is_told_otherwise(
    board: Board, pureio: smbus.SMBus
) -> None:
    board.faults.inject("timeout")

    def cost() -> float:
        begun = board.clock.now
        with pytest.raises(TimeoutError):
            pureio.read_byte(0x48)
        return board.clock.now - begun

    assert cost() == pytest.approx(1.0, abs=1e-3)
    smbus.ioctl(pureio._device.fileno(), I2C_TIMEOUT, 2)
    assert cost() == pytest.approx(0.02, abs=1e-3)


def test_a_scan_finds_the_chip(board: Board) -> None:
    assert ExtendedI2C(ABSENT_BUS, frequency=None).scan() == [0x48]


def test_pureio_runs_on_the_device_file_unchanged(pureio: smbus.SMBus) -> None:
    pureio.write_quick(0x48)
    pureio.write_i2c_block_data(0x48, 0x02, b"\x12\x34")
    assert pureio.read_bytes(0x48, 2) == b"\x12\x34"
    assert pureio.read_byte(0x48) == 0x12
    assert pureio.read_byte_data(0x48, 0x02) == 0x12
    assert pureio.read_word_data(0x48, 0x02) == 0x3412
    assert pureio.read_i2c_block_data(0x48, 0x02, 2) == b"\x12\x34"
    pureio.write_byte(0x48, 0x03)
    assert pureio.read_bytes(0x48, 2) == b"\x7f\xff"


def test_the_device_file_exists_only_while_it_is_installed(board: Board) -> None:
    bus = smbus.SMBus(ABSENT_BUS)
    bus.read_byte(0x48)
    board.device.remove()
    board.device.remove()
    with pytest.raises(OSError, match=f"Errno {errno.ENODEV}"):
        bus._device.read(1)
    bus.close()
    with pytest.raises(ValueError, match="No device found"):
        ExtendedI2C(ABSENT_BUS, frequency=None)
    assert "open" not in vars(smbus)
    assert smbus.ioctl is fcntl.ioctl
    assert adafruit_extended_bus.path is os.path


def test_other_buses_and_files_stay_real(pureio: smbus.SMBus) -> None:
    with pytest.raises(ValueError, match="No device found"):
        ExtendedI2C(ABSENT_BUS + 1, frequency=None)
    with pytest.raises(FileNotFoundError):
        smbus.SMBus(ABSENT_BUS + 1)
    reader, writer = os.pipe()
    try:
        os.write(writer, b"abc")
        waiting = array.array("i", [0])
        smbus.ioctl(reader, termios.FIONREAD, waiting)
        assert waiting[0] == 3
    finally:
        os.close(reader)
        os.close(writer)


def test_each_open_device_file_has_an_address_of_its_own(board: Board) -> None:
    other = Ads1115Chip(board.clock, lambda *_: 0.0, board.faults)
    board.bus.attach(0x49, other)
    with smbus.SMBus(ABSENT_BUS) as one, smbus.SMBus(ABSENT_BUS) as two:
        one.write_i2c_block_data(0x48, 0x02, b"\x11\x11")
        two.write_i2c_block_data(0x49, 0x02, b"\x22\x22")
        assert one._device.fileno() != two._device.fileno()
        assert (one._device.read(2), two._device.read(2)) == (b"\x11\x11", b"\x22\x22")


def test_two_buses_are_emulated_side_by_side_but_never_one_twice(board: Board) -> None:
    other = Board()
    both = LinuxI2c(other.transfer, {ABSENT_BUS, ABSENT_BUS + 1}, other.set_timeout)
    with pytest.raises(ValueError, match=f"i2c-{ABSENT_BUS} is emulated already"):
        both.install()
    with LinuxI2c(other.transfer, {ABSENT_BUS + 1}, other.set_timeout):
        ExtendedI2C(ABSENT_BUS, frequency=None).writeto(0x48, b"\x01")
    assert (board.transfers, other.transfers) == (1, 0)


@pytest.mark.parametrize(
    ("request_number", "argument", "number"),
    [(0x0703, 0x80, errno.EINVAL), (0x0720, 0, errno.ENOTTY)],
)
def test_a_request_that_the_stand_in_cannot_serve_fails_as_in_the_kernel(
    pureio: smbus.SMBus, request_number: int, argument: int, number: int
) -> None:
    with pytest.raises(OSError, match="Errno") as caught:
        smbus.ioctl(pureio._device.fileno(), request_number, argument)
    assert caught.value.errno == number


def test_a_closed_device_file_takes_no_more_requests(pureio: smbus.SMBus) -> None:
    device = pureio._device
    number = device.fileno()
    device.close()
    with pytest.raises(OSError, match="Errno") as caught:
        smbus.ioctl(number, I2C_TIMEOUT, 2)
    assert caught.value.errno == errno.EBADF
    with pytest.raises(ValueError, match="closed file"):
        device.read(1)
