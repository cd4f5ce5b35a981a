"""Continuous mode and the ALERT pin of the emulated ADS1115."""

import pytest
from ads1115_board import VOLTS, Board, X, Y, codes, config


@pytest.fixture
def board() -> Board:
    return Board()


def test_continuous_mode_converts_without_being_asked(board: Board) -> None:
    board.configure(config(X) & ~0x100)
    for volts in (0.1, 0.2, 0.3):
        board.volts[X] = volts
        board.clock.sleep(3e-3)
        assert board.register(0) == codes(volts)


def test_a_new_config_in_continuous_mode_counts_from_the_next_conversion_on(board: Board) -> None:
    board.configure(config(X) & ~0x100)
    board.wait()
    board.configure(config(Y) & ~0x100)
    board.wait()
    assert board.register(0) == codes(VOLTS[Y]) & 0xFFFF
    muxes = [mux for mux, _, _ in board.measured]
    ends = [end for _, _, end in board.measured]
    starts = [start for _, start, _ in board.measured]
    assert muxes == sorted(muxes), "X to the end of its conversion, then Y"
    assert starts[1:] == ends[:-1], "one after the other without a gap"


def test_a_long_time_in_continuous_mode_costs_nothing(board: Board) -> None:
    board.configure(config(X) & ~0x100)
    board.clock.sleep(1e5)
    assert board.register(0) == codes(VOLTS[X])
    assert len(board.measured) < 10
    assert board.clock.now - board.measured[-1][2] < 2e-3


def test_a_change_to_single_shot_ends_continuous_mode(board: Board) -> None:
    board.configure(config(X) & ~0x100)
    board.configure(config(X, start=False))
    board.wait()
    assert board.register(1) & 0x8000
    assert len(board.measured) == 1


def test_alert_is_silent_while_the_comparator_is_off(board: Board) -> None:
    board.driver().read(7)
    assert board.chip.alert


def test_alert_tells_that_a_conversion_is_ready(board: Board) -> None:
    ads = board.driver(comparator_queue_length=1)
    ads.comparator_high_threshold = -1
    ads.comparator_low_threshold = 0
    for polarity, ready in ((0x0, False), (0x8, True)):
        board.configure(config(X, low_byte=polarity))
        assert board.chip.alert is not ready
        board.wait()
        assert board.chip.alert is ready


def test_alert_pulses_after_each_conversion_in_continuous_mode(board: Board) -> None:
    ads = board.driver(comparator_queue_length=1)
    ads.comparator_high_threshold = -1
    ads.comparator_low_threshold = 0
    board.configure(config(X, low_byte=0) & ~0x100)
    pulses = 0
    before = True
    for _ in range(5000):
        board.clock.sleep(4e-6)
        pulses += before and not board.chip.alert
        before = board.chip.alert
    assert pulses == pytest.approx(0.02 * 860 * board.chip.rate_factor, abs=1.0)


def test_the_comparator_alerts_above_its_upper_threshold_until_below_its_lower_one(
    board: Board,
) -> None:
    ads = board.driver(comparator_queue_length=2)
    ads.comparator_high_threshold = codes(1.0)
    ads.comparator_low_threshold = codes(0.5)
    levels = []
    for volts in (0.8, 1.2, 1.2, 0.8, 0.4):
        board.volts[X] = volts
        ads.read(X)
        levels.append(board.chip.alert)
    assert levels == [True, True, False, False, True]


def test_a_latched_window_alert_ends_when_the_result_is_read(board: Board) -> None:
    ads = board.driver(comparator_queue_length=1, comparator_mode=0x10, comparator_latch=0x4)
    ads.comparator_high_threshold = codes(1.0)
    ads.comparator_low_threshold = codes(0.5)
    for volts, alerted in ((0.4, True), (0.7, False), (1.2, True)):
        board.volts[X] = volts
        board.configure(config(X, low_byte=0x14))
        board.wait()
        assert board.chip.alert is not alerted
        board.register(0)
        assert board.chip.alert


@pytest.mark.parametrize(("latch", "alerted"), [(0x4, True), (0x0, False)])
def test_a_latched_alert_outlives_a_conversion_that_is_back_in_the_window(
    board: Board, latch: int, alerted: bool
) -> None:
    ads = board.driver(comparator_queue_length=1)
    ads.comparator_high_threshold = codes(1.0)
    ads.comparator_low_threshold = codes(0.5)
    for volts in (1.2, 0.7):
        board.volts[X] = volts
        board.configure(config(X, low_byte=0x10 | latch))
        board.wait()
        board.register(1)
    assert board.chip.alert is not alerted
