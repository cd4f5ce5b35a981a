"""The tickers: absolute deadlines, whole slots skipped, phase kept."""

import asyncio
import time
from itertools import islice, pairwise

import pytest

from fishd.clock import Slot, Ticker, VirtualClock, VirtualTicker
from fishd.timerfd import TimerFd

PERIOD = 0.02


async def slots(count: int, *, nap_before: dict[int, float]) -> list[Slot]:
    """Slots of a real ticker; the body of a turn takes as long as `nap_before` says."""
    ticker = Ticker(PERIOD)
    found: list[Slot] = []
    try:
        async for slot in ticker:
            found.append(slot)
            if len(found) == count:
                return found
            time.sleep(nap_before.get(len(found), 0.0))
    finally:
        ticker.close()
    raise AssertionError("a ticker never ends")


def test_virtual_time_is_never_late_and_moves_its_clock() -> None:
    clock = VirtualClock()
    turns = [(slot, clock.now) for slot in islice(VirtualTicker(clock, 0.05), 3)]
    assert turns == [(Slot(k, k * 0.05, k * 0.05, 0), k * 0.05) for k in range(3)]


def test_no_tick_begins_before_its_deadline() -> None:
    for slot in asyncio.run(slots(20, nap_before={})):
        assert slot.now >= slot.deadline


def test_deadlines_are_whole_periods_apart_for_ever() -> None:
    found = asyncio.run(slots(20, nap_before={5: 0.013, 9: 0.031}))
    first = found[0]
    for slot in found:
        elapsed = slot.deadline - first.deadline
        assert elapsed == pytest.approx((slot.index - first.index) * PERIOD, abs=1e-9)


def test_a_long_turn_costs_whole_slots_which_are_counted_and_not_caught_up() -> None:
    found = asyncio.run(slots(10, nap_before={4: 3.5 * PERIOD}))
    assert found[4].missed >= 2
    for before, after in pairwise(found):
        assert after.index - before.index == after.missed + 1
        assert after.now - after.deadline < PERIOD


def test_the_asyncio_loop_is_served_between_ticks_even_under_overload() -> None:
    async def run() -> int:
        served = 0

        async def other() -> None:
            nonlocal served
            while True:
                served += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(other())
        await slots(5, nap_before=dict.fromkeys(range(5), 1.5 * PERIOD))
        task.cancel()
        return served

    assert asyncio.run(run()) >= 4


def test_a_timer_in_the_past_expires_at_once_and_can_be_closed_twice() -> None:
    async def run() -> None:
        timer = TimerFd()
        expired = asyncio.Event()
        asyncio.get_running_loop().add_reader(timer, expired.set)
        timer.arm(time.monotonic() - 1.0)
        await asyncio.wait_for(expired.wait(), 10)
        timer.clear()
        timer.clear()
        asyncio.get_running_loop().remove_reader(timer)
        timer.close()
        timer.close()
        assert timer.closed

    asyncio.run(run())


def test_a_rehearsal_comes_before_each_deadline_and_delays_no_tick() -> None:
    async def run() -> None:
        rehearsed: list[float] = []
        ticker = Ticker(PERIOD, lambda: rehearsed.append(time.monotonic()))
        try:
            async for slot in ticker:
                if slot.index >= 20:
                    break
        finally:
            ticker.close()
        assert len(rehearsed) >= 5
        deadlines = [slot.deadline - k * PERIOD for k in range(25)]
        for moment in rehearsed:
            assert any(0 < deadline - moment < Ticker.MARGIN for deadline in deadlines)

    asyncio.run(run())


def test_a_rehearsal_for_which_there_is_no_time_is_left_out() -> None:
    async def run() -> int:
        rehearsals = 0

        def slow() -> None:
            nonlocal rehearsals
            rehearsals += 1
            time.sleep(PERIOD)

        ticker = Ticker(PERIOD, slow)
        try:
            async for slot in ticker:
                if slot.index >= 20:
                    break
        finally:
            ticker.close()
        return rehearsals

    assert asyncio.run(run()) == 1
