"""Each trap of the real ADS1115 driver, shown on the emulated chip, and what avoids it."""

from collections.abc import Iterator

import pytest
from rigs.ads1115_board import VOLTS, Board, X, Y, codes, config


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as board:
        yield board


def test_a_chip_that_was_stuck_busy_goes_on_once_it_is_not(board: Board) -> None:
    ads = board.driver()
    board.configure(config(X))
    board.faults.inject("stuck-busy", 0.1)
    board.wait()
    assert not board.register(1) & 0x8000
    assert board.register(0) == 0
    board.clock.sleep(0.1)
    assert board.register(1) & 0x8000
    assert board.register(0) == codes(VOLTS[X])
    assert ads.read(Y) == codes(VOLTS[Y])


@pytest.mark.parametrize("waits", [False, True])
def test_after_an_error_amid_a_conversion_a_read_without_a_wait_returns_the_other_channel(
    board: Board, waits: bool
) -> None:
    ads = board.driver()
    ads._write_config(X)
    board.faults.inject("nack")
    with pytest.raises(OSError, match="Errno"):
        ads._conversion_complete()
    board.faults.clear()
    if waits:
        board.wait()
    assert ads.read(Y) == codes(VOLTS[Y if waits else X])
    assert ads.read(Y) == codes(VOLTS[Y])


def test_an_error_of_the_start_itself_may_leave_the_chip_converting(board: Board) -> None:
    ads = board.driver()
    swapped = 0
    for _ in range(20):
        board.faults.inject("clock-stretch")
        with pytest.raises(OSError, match="Errno"):
            ads._write_config(X)
        board.faults.clear()
        swapped += ads.read(Y) == codes(VOLTS[X])
        board.wait()
    assert 0 < swapped < 20


def test_a_brown_out_amid_a_conversion_reads_as_zero_and_shows_in_the_config(board: Board) -> None:
    ads = board.driver()
    ads._write_config(X)
    board.faults.inject("brown-out")
    assert ads._conversion_complete()
    assert board.register(1) == 0x8583, "not what was written: this tells the value is none"
    assert ads.get_last_result() == 0


def test_an_unplugged_chip_comes_back_with_its_registers_at_reset(board: Board) -> None:
    ads = board.driver()
    ads.read(X)
    board.faults.inject("unplugged", 1.0)
    with pytest.raises(OSError, match="Errno 121"):
        ads.read(X)
    board.clock.sleep(1.0)
    assert [board.register(pointer) for pointer in range(2)] == [0x0000, 0x8583]
    assert ads.read(Y) == codes(VOLTS[Y])


def test_a_frozen_code_is_that_of_its_own_channel(board: Board) -> None:
    ads = board.driver()
    before = [ads.read(X), ads.read(Y)]
    board.faults.inject("frozen-code")
    board.volts[X], board.volts[Y] = -1.0, 1.0
    assert [ads.read(X), ads.read(Y)] == before
    board.faults.clear()
    assert [ads.read(X), ads.read(Y)] == [codes(-1.0), codes(1.0)]
