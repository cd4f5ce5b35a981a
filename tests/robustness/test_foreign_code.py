"""Code of other packages, which may raise anything and never return, without harm."""

import gc
import signal
import sys
import threading
import time
import weakref
from contextlib import suppress

import pytest
from fishd_zoo import RAISED
from rigs.processes import PATIENCE, wait_until

from fishd.core.errors import Escaped
from fishd.core.foreign_code import Attempt, call_foreign


@pytest.mark.usefixtures("sigint_ignored")
@pytest.mark.parametrize("deed", RAISED)
def test_whatever_is_raised_is_an_exception_outside(deed: str) -> None:
    def misbehave() -> None:
        raise RAISED[deed]

    with pytest.raises(Exception) as caught:  # noqa: PT011  (that is what it is about)
        call_foreign(misbehave)
    error = caught.value
    assert error is RAISED[deed] or error.__cause__ is RAISED[deed]


def test_a_true_ctrl_c_passes() -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        call_foreign(interrupt)


def test_an_attempt_gives_what_is_returned_or_raises_what_is_raised() -> None:
    good, bad = Attempt(lambda: 42), Attempt(lambda: sys.exit(3))
    assert good.wait(PATIENCE)
    assert good.result() == 42
    assert bad.wait(PATIENCE)
    with pytest.raises(Escaped, match="SystemExit: 3"):
        bad.result()
    assert not good.give_up()


def test_what_a_failed_call_had_read_is_freed_without_a_garbage_collection() -> None:
    class Content:
        pass

    content = [Content()]
    alive = weakref.ref(content[0])

    def fail() -> None:
        read = content.pop()
        raise ValueError(f"{read} is no good")

    gc.disable()
    try:
        attempt = Attempt(fail)
        assert attempt.wait(PATIENCE)
        with suppress(ValueError):
            attempt.result()
        del attempt
        wait_until(lambda: alive() is None)
    finally:
        gc.enable()


def test_what_comes_too_late_is_handed_to_whoever_takes_it_away() -> None:
    begun, go, taken = threading.Event(), threading.Event(), threading.Event()
    results: list[str] = []

    def deliver() -> str:
        begun.set()
        go.wait(PATIENCE)
        return "late"

    def take(result: str) -> None:
        results.append(result)
        taken.set()

    attempt = Attempt(deliver, late=take)
    assert begun.wait(PATIENCE)
    assert attempt.give_up()
    go.set()
    assert taken.wait(PATIENCE)
    assert results == ["late"]
    assert not attempt.wait(0.0)


def test_many_that_are_given_up_just_when_they_are_done_are_either_taken_or_thrown_away() -> None:
    """A call that is abandoned at any moment never loses or duplicates its result."""
    for number in range(400):
        late: list[int] = []
        attempt = Attempt(lambda: 1, late=late.append)
        for _ in range(number):
            pass
        done = not attempt.give_up()
        deadline = time.monotonic() + PATIENCE
        while attempt.alive and time.monotonic() < deadline:
            time.sleep(0)
        assert attempt.wait(0.0) == done
        assert len(late) <= (0 if done else 1)


def test_one_given_up_before_its_thread_began_calls_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begin, calls, uncaught = threading.Event(), [], []

    class SlowToBegin(threading.Thread):
        def run(self) -> None:
            begin.wait(PATIENCE)
            super().run()

    monkeypatch.setattr(threading, "Thread", SlowToBegin)
    monkeypatch.setattr(threading, "excepthook", uncaught.append)
    attempt = Attempt(lambda: calls.append(1))
    assert attempt.give_up()
    begin.set()
    deadline = time.monotonic() + PATIENCE
    while attempt.alive and time.monotonic() < deadline:
        time.sleep(0.001)
    assert (calls, uncaught) == ([], [])
