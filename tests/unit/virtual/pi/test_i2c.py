"""Emulated I2C bus: its transfers, and the real drivers at its /dev/i2c-N."""

import errno
import fcntl
import os
from collections.abc import Iterator

import adafruit_extended_bus
import pytest
from adafruit_extended_bus import ExtendedI2C
from Adafruit_PureIO import smbus
from rigs.ads1115_board import ABSENT_BUS, Board

from fishd.virtual.pi.ads1115 import RESET_CONFIG, Ads1115Chip
from fishd.virtual.pi.faults import TRANSFER_ERRORS
from fishd.virtual.pi.i2c import I2cBus, Read, Write

RESET_WORD = 0x8000 | RESET_CONFIG


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as board:
        yield board


@pytest.fixture
def pureio(board: Board) -> Iterator[smbus.SMBus]:
    with smbus.SMBus(ABSENT_BUS) as bus:
        yield bus


def duration(board: Board, *messages: Write | Read) -> float:
    begun = board.clock.now
    board.bus.transfer(0x48, messages)
    return board.clock.now - begun


def test_a_transfer_takes_nine_bits_per_byte_and_the_kernels_time() -> None:
    for speed in (100e3, 400e3):
        board = Board(speed)
        write = duration(board, Write(b"\x01\x85\x83"))
        assert write == pytest.approx((4 * 9 + 2) / speed + I2cBus.OVERHEAD)
        combined = duration(board, Write(b"\x01"), Read(2))
        assert combined == pytest.approx((5 * 9 + 3) / speed + I2cBus.OVERHEAD)


def test_a_transfer_answers_each_of_its_reads(board: Board) -> None:
    replies = board.bus.transfer(0x48, [Write(b"\x01"), Read(2), Write(b"\x03"), Read(2)])
    assert replies == [RESET_WORD.to_bytes(2, "big"), b"\x7f\xff"]


@pytest.mark.parametrize("address", [0x00, 0x49])
def test_nobody_acknowledges_an_address_without_a_chip(board: Board, address: int) -> None:
    for message in (Write(b""), Write(b"\x06"), Read(1)):
        with pytest.raises(OSError, match="Errno 121"):
            board.bus.transfer(address, [message])


def test_a_failed_transfer_may_have_reached_the_chip_all_the_same(board: Board) -> None:
    outcomes: dict[str, set[bool]] = {}
    for fault in TRANSFER_ERRORS:
        for _ in range(50):
            board.chip.reset()
            board.faults.inject(fault)
            with pytest.raises(OSError, match="Errno"):
                board.bus.transfer(0x48, [Write(b"\x02\x12\x34")])
            board.faults.clear()
            board.bus.transfer(0x48, [Write(b"\x02")])
            stored = board.bus.transfer(0x48, [Read(2)]) == [b"\x12\x34"]
            outcomes.setdefault(fault, set()).add(stored)
    assert outcomes == {
        "nack": {False},
        "timeout": {False, True},
        "clock-stretch": {False, True},
        "bus-owned": {False},
        "arbitration-lost": {False, True},
    }


I2C_TIMEOUT = 0x0702


def test_a_hanging_bus_costs_a_second_or_the_limit(board: Board, pureio: smbus.SMBus) -> None:
    board.faults.inject("timeout")

    def cost() -> float:
        begun = board.clock.now
        with pytest.raises(TimeoutError):
            pureio.read_byte(0x48)
        return board.clock.now - begun

    assert cost() == pytest.approx(1.0, abs=1e-3)
    smbus.ioctl(pureio._device.fileno(), I2C_TIMEOUT, 2)
    assert cost() == pytest.approx(0.02, abs=1e-3)


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


def test_each_open_device_file_has_an_address_of_its_own(board: Board) -> None:
    second_chip = Ads1115Chip(board.clock, lambda *_: 0.0, board.faults)
    board.bus.attach(0x49, second_chip)
    with smbus.SMBus(ABSENT_BUS) as first, smbus.SMBus(ABSENT_BUS) as second:
        first.write_i2c_block_data(0x48, 0x02, b"\x11\x11")
        second.write_i2c_block_data(0x49, 0x02, b"\x22\x22")
        assert first._device.fileno() != second._device.fileno()
        assert (first._device.read(2), second._device.read(2)) == (b"\x11\x11", b"\x22\x22")
