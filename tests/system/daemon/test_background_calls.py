"""Calls in threads: limited in number and in time, without delays for the rest of fishd."""

import asyncio
import threading
import time
from collections.abc import Callable

import pytest
from rigs.processes import wait_until

from fishd.core.errors import Refused
from fishd.daemon.background_calls import MAX_ABANDONED_CALLS, MAX_CALLS, BackgroundCalls

TIMEOUT_S = 60.0


class Stuck:
    """Function whose calls end only when `let_go` is called."""

    def __init__(self) -> None:
        self.entered = threading.Event()
        """Event of the next call."""
        self._go = threading.Event()
        self.threads: list[threading.Thread] = []

    def __call__(self) -> None:
        entered = self.entered
        self.threads.append(threading.current_thread())
        entered.set()
        self._go.wait(TIMEOUT_S)

    def let_go(self) -> None:
        self._go.set()
        for thread in self.threads:
            thread.join(TIMEOUT_S)


async def refusal(background: BackgroundCalls, function: Callable[[], object]) -> Refused:
    with pytest.raises(Refused) as refused:
        await background.call("it has not loaded", function)
    return refused.value


@pytest.mark.realtime
def test_one_that_takes_too_long_is_refused_in_time_and_others_go_on() -> None:
    stuck = Stuck()

    async def run() -> None:
        background = BackgroundCalls(0.1)
        started = time.monotonic()
        answers = await asyncio.gather(*(refusal(background, stuck) for _ in range(MAX_CALLS)))
        assert time.monotonic() - started < 2.0
        assert {answer.code for answer in answers} == {"too-slow"}
        assert str(answers[0]) == "it has not loaded within 0.1 s; the call is abandoned"
        background.check_busy()  # abandoned calls do not count
        background.timeout = TIMEOUT_S
        assert await background.call("", lambda: 42) == 42

    asyncio.run(run())
    stuck.let_go()


def test_four_at_once_are_all() -> None:
    stuck = Stuck()

    async def run() -> None:
        background = BackgroundCalls(TIMEOUT_S)
        pending = [asyncio.create_task(background.call("", stuck)) for _ in range(MAX_CALLS)]
        await asyncio.sleep(0)  # starts all of them
        with pytest.raises(Refused, match="4 requests are reading files; try again"):
            background.check_busy()
        stuck.let_go()
        await asyncio.gather(*pending)
        background.check_busy()

    asyncio.run(run())


def test_so_many_that_would_not_end_are_enough_until_one_ends() -> None:
    stuck = Stuck()

    async def run() -> None:
        background = BackgroundCalls(TIMEOUT_S)
        for _ in range(MAX_ABANDONED_CALLS):
            background.check_busy()
            stuck.entered = threading.Event()
            call = asyncio.create_task(background.call("", stuck))
            await asyncio.to_thread(stuck.entered.wait, TIMEOUT_S)
            call.cancel()
            with pytest.raises(asyncio.CancelledError):
                await call
        with pytest.raises(Refused, match="abandoned calls, mostly of controllers, still run; res"):
            background.check_busy()
        stuck.let_go()
        background.check_busy()

    asyncio.run(run())


@pytest.mark.realtime
def test_a_process_does_not_wait_for_one_that_never_ends() -> None:
    started = time.monotonic()
    asyncio.run(refusal(BackgroundCalls(0.05), lambda: time.sleep(5.0)))
    assert time.monotonic() - started < 3.0


def test_a_call_whose_client_is_gone_is_given_up() -> None:
    late: list[int] = []
    stuck = Stuck()

    def load() -> int:
        stuck()
        return 42

    async def run() -> None:
        background = BackgroundCalls(TIMEOUT_S)
        call = asyncio.create_task(background.call("", load, late=late.append))
        await asyncio.to_thread(stuck.entered.wait, TIMEOUT_S)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        stuck.let_go()
        await asyncio.to_thread(wait_until, lambda: bool(late))

    asyncio.run(run())
    assert late == [42]
