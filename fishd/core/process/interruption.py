"""Ctrl-C, SIGTERM and SIGHUP: what a program that moves a fish or computes for long does then."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """One of these signals came; no code of others may catch it."""


@contextmanager
def on_signal(ask: Callable[[], object]) -> Iterator[None]:
    """While this lasts, SIGINT, SIGTERM and SIGHUP call `ask`; the second of a kind acts as before.

    Only the main thread receives signals; in any other nothing happens.
    """

    def heard(number: int, _: object) -> None:
        signal.signal(number, former[number])
        ask()

    with handled(SIGNALS, heard) as former:
        yield


@contextmanager
def interrupted_once() -> Iterator[None]:
    """While this lasts, the first of the three raises `Interrupted`, and the others nothing.

    So what is done then, such as stopping a fish, is done to its end. Main thread only.
    """

    def heard(number: int, _: object) -> None:
        for each in SIGNALS:
            signal.signal(each, signal.SIG_IGN)
        raise Interrupted

    with handled(SIGNALS, heard):
        yield


@contextmanager
def held_back(signals: Iterable[int] = SIGNALS) -> Iterator[None]:
    """What comes while this lasts acts as before as soon as it ends."""
    came: list[int] = []
    try:
        with handled(signals, lambda number, _: came.append(number)):
            yield
    finally:
        for number in came:
            signal.raise_signal(number)


@contextmanager
def handled(signals: Iterable[int], handler: Any) -> Iterator[dict[int, Any]]:
    """While this lasts, these go to `handler`, in the main thread; yields who had them before.

    One that is ignored, as `nohup` has it, stays so.
    """
    former: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        heard = [each for each in signals if signal.getsignal(each) is not signal.SIG_IGN]
        former = {number: signal.signal(number, handler) for number in heard}
    try:
        yield former
    finally:
        for number, before in former.items():
            signal.signal(number, before)
