"""Each trap of the real ADS1115 driver, shown on the emulated chip, and what avoids it."""

import types
from collections.abc import Sequence

import pytest
from adafruit_ads1x15 import ADS1115, ads1x15
from ads1115_board import VOLTS, Board, Enough, X, Y, codes, config

from fishd.emulation.busio_i2c import BusioI2c
from fishd.emulation.i2c import Message, Read, Write


@pytest.fixture
def board() -> Board:
    return Board()


def test_an_absent_chip_is_a_value_error_at_the_start(board: Board) -> None:
    with pytest.raises(ValueError, match="No I2C device at address: 0x49"):
        ADS1115(BusioI2c(board.transfer), address=0x49)
    board.faults.inject("unplugged")
    with pytest.raises(ValueError, match="No I2C device at address: 0x48"):
        board.driver()


@pytest.mark.parametrize("zero_length", [True, False])
def test_the_driver_probes_with_a_write_of_nothing_or_else_with_a_read(zero_length: bool) -> None:
    board = Board(zero_length=zero_length)
    seen: list[Message] = []

    def transfer(address: int, messages: Sequence[Message]) -> list[bytes]:
        seen.extend(messages)
        return board.bus.transfer(address, messages)

    ads = ADS1115(BusioI2c(transfer), data_rate=860)
    assert seen[0] == Write(b"")
    assert (Read(1) in seen) is not zero_length
    assert ads.read(X) == codes(VOLTS[X])


def test_a_single_shot_read_spins_without_a_pause_until_the_chip_is_ready(board: Board) -> None:
    ads = board.driver(data_rate=8)
    board.transfers = 0
    ads.read(X)
    assert board.transfers > 500, "polls in one conversion of 125 ms"


def test_a_chip_that_is_stuck_busy_would_hold_the_driver_for_ever(board: Board) -> None:
    ads = board.driver()
    board.faults.inject("stuck-busy")
    board.allowed = board.transfers + 10_000
    with pytest.raises(Enough):
        ads.read(X)
    assert board.clock.now > 1.0


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


def test_after_an_error_amid_a_conversion_the_next_read_returns_the_other_channel(
    board: Board,
) -> None:
    ads = board.driver()
    ads._write_config(X)
    board.faults.inject("nack")
    with pytest.raises(OSError, match="Errno"):
        ads._conversion_complete()
    board.faults.clear()
    assert ads.read(Y) == codes(VOLTS[X]), "the trap: F_x comes back as F_y"
    assert ads.read(Y) == codes(VOLTS[Y])


def test_a_wait_after_an_error_prevents_the_swap_of_channels() -> None:
    for seed in range(10):
        board = Board(seed=seed)
        ads = board.driver()
        ads._write_config(X)
        board.faults.inject("nack")
        with pytest.raises(OSError, match="Errno"):
            ads._conversion_complete()
        board.faults.clear()
        board.wait(860)
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


def test_a_brown_out_heals_with_the_next_single_shot_read(board: Board) -> None:
    ads = board.driver(gain=16)
    board.volts[X] = 0.2
    board.faults.inject("brown-out")
    assert board.register(1) == 0x8583, "gain and rate are lost"
    assert ads.read(X) == codes(0.2, 0.256)


def test_a_brown_out_amid_a_conversion_reads_as_zero_and_shows_in_the_config(board: Board) -> None:
    ads = board.driver()
    ads._write_config(X)
    board.faults.inject("brown-out")
    assert ads._conversion_complete()
    assert board.register(1) == 0x8583, "not what was written: this tells the value is none"
    assert ads.get_last_result() == 0


def test_continuous_mode_of_the_driver_ignores_the_pin(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ads1x15, "time", types.SimpleNamespace(sleep=board.clock.sleep))
    ads = board.driver(mode=ads1x15.Mode.CONTINUOUS)
    assert ads.read(X) == codes(VOLTS[X])
    assert ads.read(Y) == codes(VOLTS[X]), "the trap: the multiplexer is never set"


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


def test_a_clipped_input_reads_full_scale(board: Board) -> None:
    ads = board.driver()
    board.faults.inject("clipped")
    assert [ads.read(X), ads.read(Y)] == [32767, 32767]
