"""Calls beside the loop: limited in number and in time, and never in anybody's way."""

import asyncio
import threading
import time
from collections.abc import Callable

import pytest

from fishd.asides import MOST_AT_ONCE, MOST_GIVEN_UP, Asides
from fishd.errors import Refused

PATIENCE = 10.0


class Stuck:
    """Calls that nothing ends until they are let go."""

    def __init__(self) -> None:
        self._go = threading.Event()
        self.threads: list[threading.Thread] = []

    def __call__(self) -> None:
        self.threads.append(threading.current_thread())
        while not self._go.is_set():
            try:
                self._go.wait(PATIENCE)
            except BaseException:
                continue

    def let_go(self) -> None:
        self._go.set()
        for thread in self.threads:
            thread.join(PATIENCE)


async def refusal(asides: Asides, function: Callable[[], object]) -> Refused:
    with pytest.raises(Refused) as refused:
        await asides.call("it has not loaded", function)
    return refused.value


def test_one_that_takes_too_long_is_refused_in_time_and_others_go_on() -> None:
    stuck = Stuck()

    async def run() -> None:
        asides = Asides(0.1)
        begun = time.monotonic()
        answers = await asyncio.gather(*(refusal(asides, stuck) for _ in range(MOST_AT_ONCE)))
        assert time.monotonic() - begun < 2.0
        assert {answer.code for answer in answers} == {"too-slow"}
        assert str(answers[0]) == "it has not loaded within 0.1 s; it is given up"
        asides.check_busy()  # those that are given up no longer count
        assert await asides.call("", lambda: 42) == 42

    asyncio.run(run())
    stuck.let_go()


def test_four_at_once_are_all() -> None:
    stuck = Stuck()

    async def run() -> None:
        asides = Asides(0.3)
        calls = [asyncio.create_task(refusal(asides, stuck)) for _ in range(MOST_AT_ONCE)]
        await asyncio.sleep(0.05)
        with pytest.raises(Refused, match="4 requests are reading files; try again"):
            asides.check_busy()
        await asyncio.gather(*calls)

    asyncio.run(run())
    stuck.let_go()


def test_so_many_that_would_not_end_are_enough_until_one_ends() -> None:
    stuck = Stuck()

    async def run() -> None:
        asides = Asides(0.02)
        for _ in range(MOST_GIVEN_UP):
            asides.check_busy()
            await refusal(asides, stuck)
        with pytest.raises(Refused, match="of controllers mostly, still run; restart fishd"):
            asides.check_busy()
        stuck.let_go()
        asides.check_busy()

    asyncio.run(run())


def test_a_process_does_not_wait_for_one_that_never_ends() -> None:
    begun = time.monotonic()
    asyncio.run(refusal(Asides(0.05), lambda: time.sleep(5.0)))
    assert time.monotonic() - begun < 3.0


def test_a_call_whose_client_is_gone_is_given_up() -> None:
    late: list[int] = []
    go = threading.Event()

    def load() -> int:
        while not go.is_set():
            try:
                go.wait(PATIENCE)
            except BaseException:
                continue
        return 42

    async def run() -> None:
        asides = Asides(PATIENCE)
        call = asyncio.create_task(asides.call("", load, late=late.append))
        await asyncio.sleep(0.05)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        go.set()
        deadline = time.monotonic() + PATIENCE
        while not late and time.monotonic() < deadline:
            await asyncio.sleep(0.01)

    asyncio.run(run())
    assert late == [42]
