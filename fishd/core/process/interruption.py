"""Handling of Ctrl-C, SIGTERM and SIGHUP in programs that move a fish or compute for long."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(KeyboardInterrupt):
    """One of these signals arrived; code of other packages must not catch it."""


@contextmanager
def on_signal(ask: Callable[[], object]) -> Iterator[None]:
    """Call `ask` on SIGINT, SIGTERM and SIGHUP; the second signal of a kind acts as before.

    Only the main thread receives signals; in any other thread this has no effect.
    """

    def heard(number: int, _: object) -> None:
        signal.signal(number, former[number])
        ask()

    with handle_signals(SIGNALS, heard) as former:
        yield


@contextmanager
def raise_on_first_signal() -> Iterator[None]:
    """Raise `Interrupted` on the first of the three signals, and ignore later ones.

    The cleanup then, such as stopping a fish, runs to its end. Main thread only.
    """

    def heard(number: int, _: object) -> None:
        for signal_number in SIGNALS:
            signal.signal(signal_number, signal.SIG_IGN)
        raise Interrupted

    with handle_signals(SIGNALS, heard):
        yield


@contextmanager
def defer_signals(signals: Iterable[int] = SIGNALS) -> Iterator[None]:
    """Defer these signals until the end of the context."""
    received: list[int] = []
    try:
        with handle_signals(signals, lambda number, _: received.append(number)):
            yield
    finally:
        for number in received:
            signal.raise_signal(number)


@contextmanager
def handle_signals(signals: Iterable[int], handler: Any) -> Iterator[dict[int, Any]]:
    """Handle these signals with `handler`, in the main thread; yield the former handlers.

    A signal that is ignored, as below `nohup`, stays ignored.
    """
    former: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        active = [
            candidate for candidate in signals if signal.getsignal(candidate) is not signal.SIG_IGN
        ]
        former = {number: signal.signal(number, handler) for number in active}
    try:
        yield former
    finally:
        for number, before in former.items():
            signal.signal(number, before)
