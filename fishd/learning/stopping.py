"""SIGINT, SIGTERM and SIGHUP ask a training to stop; it then ends with a checkpoint."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def on_signal(ask: Callable[[], object]) -> Iterator[None]:
    """While this lasts, each of these signals calls `ask`; the second of a kind acts as before.

    Only the main thread hears signals; in any other nothing happens.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def heard(number: int, _: object) -> None:
        signal.signal(number, former[number])
        ask()

    former: dict[int, Any] = {
        number: signal.signal(number, heard)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
