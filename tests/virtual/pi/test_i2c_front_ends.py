"""The two ways of drivers to the emulated bus: a device file, and an object like busio.I2C."""

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
from ads1115_board import ABSENT_BUS, Board

from fishd.emulation.ads1115 import RESET_CONFIG, Ads1115Chip
from fishd.emulation.busio_i2c import BusioI2c

RESET_WORD = 0x8000 | RESET_CONFIG
I2C_TIMEOUT = 0x0702


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def pureio(board: Board) -> Iterator[smbus.SMBus]:
    with board.device_file(), smbus.SMBus(ABSENT_BUS) as bus:
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
    with board.device_file():
        for front_end in (BusioI2c(board.bus.transfer), ExtendedI2C(ABSENT_BUS, frequency=None)):
            board.faults.inject(fault)
            for call in (
                lambda i2c: i2c.writeto(0x48, b"\x01"),
                lambda i2c: i2c.readfrom_into(0x48, bytearray(2)),
                lambda i2c: i2c.writeto_then_readfrom(0x48, b"\x01", bytearray(2)),
            ):
                with pytest.raises(OSError, match="Errno") as caught:
                    call(front_end)
                assert (type(caught.value), caught.value.errno) == (kind, number)
            board.faults.clear()
            word = bytearray(2)
            front_end.writeto_then_readfrom(0x48, b"\x01", word)
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


def test_both_front_ends_find_the_chip_by_scanning(board: Board) -> None:
    with board.device_file():
        assert ExtendedI2C(ABSENT_BUS, frequency=None).scan() == [0x48]
    assert BusioI2c(board.bus.transfer).scan() == [0x48]


def test_a_bus_without_zero_length_writes_is_scanned_by_reading() -> None:
    board = Board(zero_length=False)
    with board.device_file():
        assert ExtendedI2C(ABSENT_BUS, frequency=None).scan() == [0x48]
    assert BusioI2c(board.bus.transfer).scan() == [0x48]


def test_only_one_holder_gets_the_bus_of_the_busio_front_end(board: Board) -> None:
    i2c = BusioI2c(board.bus.transfer)
    assert i2c.try_lock()
    assert not i2c.try_lock()
    i2c.unlock()
    i2c.unlock()
    assert i2c.try_lock()


def test_slices_of_buffers_are_written_and_filled(board: Board) -> None:
    i2c = BusioI2c(board.bus.transfer)
    i2c.writeto(0x48, b"\xff\x02\x12\x34\xff", start=1, end=4)
    word = bytearray(4)
    i2c.readfrom_into(0x48, word, start=1, end=3)
    assert word == b"\x00\x12\x34\x00"
    i2c.writeto_then_readfrom(0x48, b"\xff\x03", word, out_start=1, in_start=2)
    assert word == b"\x00\x12\x7f\xff"


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
    with board.device_file():
        ExtendedI2C(ABSENT_BUS, frequency=None)
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
    with board.device_file(), smbus.SMBus(ABSENT_BUS) as one, smbus.SMBus(ABSENT_BUS) as two:
        one.write_i2c_block_data(0x48, 0x02, b"\x11\x11")
        two.write_i2c_block_data(0x49, 0x02, b"\x22\x22")
        assert one._device.fileno() != two._device.fileno()
        assert (one._device.read(2), two._device.read(2)) == (b"\x11\x11", b"\x22\x22")


def test_a_device_file_whose_bus_was_removed_has_no_device(board: Board) -> None:
    emulation = board.device_file()
    emulation.install()
    with smbus.SMBus(ABSENT_BUS) as bus:
        bus.read_byte(0x48)
        emulation.remove()
        emulation.remove()
        with pytest.raises(OSError, match="Errno"):
            bus.read_byte(0x48)
        with pytest.raises(OSError, match="Errno") as caught:
            bus._device.read(1)
        assert caught.value.errno == errno.ENODEV


def test_two_buses_are_emulated_side_by_side_but_never_one_twice(board: Board) -> None:
    other = Board()
    with board.device_file(), other.device_file(ABSENT_BUS + 1):
        with pytest.raises(ValueError, match=f"i2c-{ABSENT_BUS} is emulated already"):
            other.device_file().install()
        ExtendedI2C(ABSENT_BUS, frequency=None).writeto(0x48, b"\x01")
        assert board.clock.now > 0.0
        assert other.clock.now == 0.0


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
