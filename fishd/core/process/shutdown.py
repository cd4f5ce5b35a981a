"""The orderly shutdown that a signal asks for, and a last resort where the process hangs."""

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import NoReturn

from fishd.core import text
from fishd.core.process import realtime

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
PATIENCE = 2.0
"""Time from a signal until fishd no longer waits for an orderly shutdown [s]."""
_RELEASE = 0.5
"""Time that the last resort has to release the servo then [s]."""
_WORDS = 0.4
"""Time that it has to say so, and more if the release left some: a busy machine is slow [s]."""
_FLUSH = 0.1
"""Time to write the rest of the output at the very end, the last part of that [s]."""


class Shutdown:
    """Waits for a signal in a thread, asks for an orderly shutdown, and ends what hangs.

    A signal reaches this thread even where the main one is stuck, as long as that does not keep
    the interpreter to itself: then only SIGKILL helps, which systemd's watchdog sends.
    """

    def __init__(self) -> None:
        """Call it from the main thread. SIGHUP stays ignored where it is, as below `nohup`."""
        self._asked = threading.Event()
        self._tell: Callable[[], object] = lambda: None
        self.release: Callable[[], None] | None = None
        """Releases the servo, from any thread; called where fishd hangs. None while it starts."""
        self.last_words: Callable[[], None] = lambda: None
        """Writes the rest of the log, as far as that is possible at once."""
        self._main = threading.get_ident()
        self._reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in SIGNALS:
            if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _ignore)
        self._thread = threading.Thread(target=self._watch, name="shutdown", daemon=True)
        self._thread.start()

    def outrank(self, priority: int) -> None:
        """Let its thread preempt a loop of this SCHED_FIFO priority, where that is permitted."""
        assert self._thread.native_id
        realtime.outrank(self._thread.native_id, priority)

    def when_asked(self, tell: Callable[[], object]) -> None:
        """Call `tell` from the waiting thread at the first signal; at once if there was one."""
        self._tell = tell
        if self._asked.is_set():
            tell()

    def _watch(self) -> None:
        while (number := os.read(self._reader, 1)[0]) not in SIGNALS:
            pass  # of others that have a handler
        self._asked.set()
        with suppress(RuntimeError):  # asyncio's loop has ended
            self._tell()
        time.sleep(PATIENCE)
        self._end_at_once(signal.Signals(number).name)

    def _end_at_once(self, name: str) -> NoReturn:
        """Waits for no lock: the thread that hangs may hold any, that of logging too."""
        end = time.monotonic() + _RELEASE + _WORDS
        if not self.release:
            what = "it has not begun to drive the servo;"
        elif _within(_RELEASE, self.release):
            what = "the servo is released and"
        else:
            what = "the servo may keep its pulses ('fishctl release' releases it) and"
        place = _place(sys._current_frames().get(self._main))
        line = (
            f"{name} came {PATIENCE:g} s ago, and fishd hangs {place}: {what} the process is ended"
        )
        _within(end - _FLUSH - time.monotonic(), partial(log.critical, "%s", line))
        _within(max(_FLUSH, end - time.monotonic()), self.last_words)
        os._exit(1)


def leave(status: int) -> NoReturn:
    """End the process without waiting for threads or for a reader of the output."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as where it was closed before the start
            _within(_FLUSH, stream.flush)
    os._exit(status)


def _within(seconds: float, function: Callable[[], object]) -> bool:
    """Call it, and wait for so long [s] at most: has it returned, and raised nothing?"""
    returned = threading.Event()

    def call() -> None:
        with suppress(Exception):
            function()
            returned.set()

    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(max(0.0, seconds))
    return returned.is_set()


def _ignore(number: int, frame: FrameType | None) -> None:
    """A signal needs a handler to wake the thread that waits for it."""


def _place(frame: FrameType | None) -> str:
    """Where a thread is, in words."""
    if frame is None:
        return "somewhere"
    code = frame.f_code
    return text.line(f"in {code.co_name}, {code.co_filename}:{frame.f_lineno}")
