"""The emulated I2C bus: how long its transfers take and how they fail."""

import threading

import pytest
from rigs.ads1115_board import Board
from rigs.processes import PATIENCE

from fishd.core.clock import VirtualClock
from fishd.virtual.pi.ads1115 import RESET_CONFIG, Ads1115Chip
from fishd.virtual.pi.faults import TRANSFER_ERRORS, Faults
from fishd.virtual.pi.i2c import I2cBus, Read, Write

RESET_WORD = 0x8000 | RESET_CONFIG


@pytest.fixture
def board() -> Board:
    return Board()


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


def test_an_address_takes_one_chip_only(board: Board) -> None:
    with pytest.raises(ValueError, match="0x48 is taken"):
        board.bus.attach(0x48, board.chip)


def test_transfers_from_several_threads_queue() -> None:
    class Watched(VirtualClock):
        inside = 0
        most = 0

        def sleep(self, seconds: float) -> None:
            self.inside += 1
            self.most = max(self.most, self.inside)
            threading.Event().wait(0.001)
            super().sleep(seconds)
            self.inside -= 1

    clock = Watched()
    faults = Faults(clock)
    bus = I2cBus(clock, 400e3, faults)
    bus.attach(0x48, Ads1115Chip(clock, lambda *_: 0.0, faults))
    together = threading.Barrier(4)
    replies: list[bytes] = []

    def work() -> None:
        together.wait(PATIENCE)
        for _ in range(5):
            replies.extend(bus.transfer(0x48, [Write(b"\x01"), Read(2)]))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    assert replies == [RESET_WORD.to_bytes(2, "big")] * 20
    assert clock.most == 1


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
