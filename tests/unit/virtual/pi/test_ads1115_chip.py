"""Measurements and speed of the emulated ADS1115, its registers, and its faults."""

import statistics
from collections.abc import Iterator

import pytest
from adafruit_ads1x15 import AnalogIn
from rigs.ads1115_board import VOLTS, Board, X, Y, codes, config

from fishd.virtual.pi.ads1115 import DATA_RATES, POWER_UP
from fishd.virtual.pi.i2c import Read, Write

PINS = [(0, 1), (0, 3), (1, 3), (2, 3), (0,), (1,), (2,), (3,)]
"""Arguments of AnalogIn, by mux bits."""


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as board:
        yield board


def test_the_driver_reads_every_input(board: Board) -> None:
    ads = board.driver()
    assert [AnalogIn(ads, *pins).value for pins in PINS] == [codes(volts) for volts in VOLTS]


@pytest.mark.parametrize(("gain", "full_scale"), [(2 / 3, 6.144), (2, 2.048), (16, 0.256)])
def test_a_code_is_a_share_of_its_range(board: Board, gain: float, full_scale: float) -> None:
    board.volts[:3] = [0.2, 1.001 * full_scale, -1.001 * full_scale]
    ads = board.driver(gain=gain)
    assert ads.read(0) == codes(0.2, full_scale)
    assert ads.read(1) == 32767
    assert ads.read(2) == -32768


def test_noise_is_as_large_as_asked_for_and_the_same_for_the_same_seed() -> None:
    def readings(seed: int) -> list[int]:
        with Board(noise=5.0, seed=seed) as board:
            ads = board.driver()
            return [ads.read(X) for _ in range(400)]

    noisy_codes = readings(1)
    assert statistics.stdev(noisy_codes) == pytest.approx(5.0, rel=0.15)
    assert statistics.mean(noisy_codes) == pytest.approx(codes(VOLTS[X]), abs=1.0)
    assert readings(1) == noisy_codes != readings(2)


@pytest.mark.parametrize(
    ("chip", "bits", "rate"),
    [(chip, bits, rate) for chip, rates in DATA_RATES.items() for bits, rate in enumerate(rates)],
)
def test_a_conversion_lasts_a_period_of_a_rate_that_is_off_by_a_tenth(
    chip: int, bits: int, rate: int
) -> None:
    lengths = []
    for seed in range(20):
        board = Board(seed=seed, bits=chip)
        board.configure(config(X, rate=bits))
        begun = board.clock.now
        board.clock.sleep(1.2 / rate)
        assert board.register(0) == pytest.approx(codes(VOLTS[X]), abs=0 if chip == 16 else 8)
        (_, start, end) = board.measured[0]
        assert start == pytest.approx(begun + POWER_UP)
        lengths.append((end - start) * rate)
    assert 1 / 1.1 <= min(lengths) < 0.97
    assert 1.03 < max(lengths) <= 1 / 0.9


def test_registers_are_read_and_written_by_their_pointer(board: Board) -> None:
    board.bus.transfer(0x48, [Write(b"\x02\x12\x34")])
    answers = [board.bus.transfer(0x48, [Read(n)]) for n in (1, 2, 3)]
    assert answers == [[b"\x12"], [b"\x12\x34"], [b"\x12\x34\xff"]]
    board.bus.transfer(0x48, [Write(b"\x03\x12")])  # half a word
    assert board.register(3) == 0x7FFF


def test_an_ads1015_has_neither_codes_nor_thresholds_between_its_steps() -> None:
    with Board(bits=12) as board:
        board.volts[:3] = [0.2, 5.0, -5.0]
        ads = board.driver(gain=2)
        assert [ads.read(mux) for mux in range(3)] == [3200, 0x7FF0, -0x8000]
        assert board.register(3) == 0x7FF0
        board.bus.transfer(0x48, [Write(b"\x03\x12\x3f")])
        assert board.register(3) == 0x1230


def test_a_busy_chip_tells_so_and_ignores_a_start(board: Board) -> None:
    board.configure(config(X))
    assert not board.register(1) & 0x8000
    board.configure(config(Y))
    board.wait()
    assert board.register(1) == config(Y), "the config is kept, but it did not start"
    assert board.register(0) == codes(VOLTS[X])
    assert [mux for mux, _, _ in board.measured] == [X]


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
    assert [board.register(pointer) for pointer in range(4)] == [0x0000, 0x8583, 0x8000, 0x7FFF]
    assert ads.read(Y) == codes(VOLTS[Y])


def test_a_frozen_code_is_that_of_its_own_channel(board: Board) -> None:
    ads = board.driver()
    before = [ads.read(X), ads.read(Y)]
    board.faults.inject("frozen-code")
    board.volts[X], board.volts[Y] = -1.0, 1.0
    assert [ads.read(X), ads.read(Y)] == before
    board.faults.clear()
    assert [ads.read(X), ads.read(Y)] == [codes(-1.0), codes(1.0)]
