"""The tickers: absolute deadlines, whole slots skipped, phase kept."""

import asyncio
import time
from collections.abc import Mapping
from itertools import islice, pairwise

import pytest

from fishd.core.clock import Slot, Ticker, VirtualClock, virtual_slots

PERIOD = 0.02


async def slots(
    count: int,
    nap_before: Mapping[int, float] | None = None,
) -> list[Slot]:
    """Return slots of a real ticker; `nap_before` holds the time that the body of a turn takes."""
    ticker = Ticker(PERIOD)
    collected: list[Slot] = []
    try:
        async for slot in ticker:
            collected.append(slot)
            if len(collected) == count:
                return collected
            time.sleep((nap_before or {}).get(len(collected), 0.0))
    finally:
        ticker.close()
    raise AssertionError("a ticker never ends")


def test_virtual_time_is_never_late_and_moves_its_clock() -> None:
    clock = VirtualClock()
    turns = [(slot, clock.now) for slot in islice(virtual_slots(clock, 0.05), 3)]
    assert turns == [(Slot(k, k * 0.05, k * 0.05, 0), k * 0.05) for k in range(3)]


def test_a_long_turn_costs_whole_slots_which_are_counted_and_not_caught_up() -> None:
    collected = asyncio.run(slots(20, {4: 3.5 * PERIOD, 9: 0.031}))
    assert collected[4].missed >= 2
    for before, after in pairwise(collected):
        assert after.index - before.index == after.missed + 1
        assert 0.0 <= after.now - after.deadline < PERIOD
        elapsed = after.deadline - collected[0].deadline
        assert elapsed == pytest.approx((after.index - collected[0].index) * PERIOD, abs=1e-9)


def test_the_asyncio_loop_is_served_between_ticks_even_under_overload() -> None:
    async def run() -> int:
        served = 0

        async def count_turns() -> None:
            nonlocal served
            while True:
                served += 1
                await asyncio.sleep(0)

        task = asyncio.create_task(count_turns())
        await slots(5, dict.fromkeys(range(5), 1.5 * PERIOD))
        task.cancel()
        return served

    assert asyncio.run(run()) >= 4
