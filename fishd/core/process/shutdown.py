"""Orderly shutdown on a signal, and a last resort if the process hangs."""

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
SHUTDOWN_TIMEOUT_S = 2.0
"""Maximum time from a signal to the end of an orderly shutdown [s]."""
_RELEASE_TIMEOUT_S = 0.5
"""Maximum time for the last resort to release the servo after that [s]."""
_MESSAGE_TIMEOUT_S = 0.4
"""Time to log the outcome, in addition to what the release has left: a busy machine is slow [s]."""
_FLUSH_TIMEOUT_S = 0.1
"""Time to write the rest of the output at the very end, the last part of the time above [s]."""


class Shutdown:
    """Thread that waits for a signal, requests an orderly shutdown, and ends a process that hangs.

    A signal reaches this thread even if the main thread hangs, unless that keeps the interpreter:
    then only SIGKILL helps, which systemd's watchdog sends.
    """

    def __init__(self) -> None:
        """Create it in the main thread. SIGHUP stays ignored if it is, as below `nohup`."""
        self._asked = threading.Event()
        self._tell: Callable[[], object] = lambda: None
        self.release: Callable[[], None] | None = None
        """Function that releases the servo, from any thread; called if fishd hangs. None at
        startup."""
        self.last_words: Callable[[], None] = lambda: None
        """Function that writes the rest of the log, as far as that is possible at once."""
        self._main = threading.get_ident()
        self._reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in SIGNALS:
            if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _ignore)
        self._thread = threading.Thread(target=self._watch, name="shutdown", daemon=True)
        self._thread.start()

    def raise_priority(self, priority: int) -> None:
        """Let this thread preempt a loop of this SCHED_FIFO priority, if that is permitted."""
        assert self._thread.native_id
        realtime.raise_priority(self._thread.native_id, priority)

    def call_when_requested(self, request: Callable[[], object]) -> None:
        """Call `request` from the waiting thread at the first signal; at once if there was one."""
        self._tell = request
        if self._asked.is_set():
            request()

    def _watch(self) -> None:
        while (number := os.read(self._reader, 1)[0]) not in SIGNALS:
            pass  # other signals that have a handler
        self._asked.set()
        with suppress(RuntimeError):  # asyncio's loop has ended
            self._tell()
        time.sleep(SHUTDOWN_TIMEOUT_S)
        self._end_at_once(signal.Signals(number).name)

    def _end_at_once(self, name: str) -> NoReturn:
        """Release the servo, log, and exit, without any lock: the hanging thread may hold it."""
        end = time.monotonic() + _RELEASE_TIMEOUT_S + _MESSAGE_TIMEOUT_S
        if not self.release:
            outcome = "it has not begun to drive the servo;"
        elif _call_within(_RELEASE_TIMEOUT_S, self.release):
            outcome = "the servo is released and"
        else:
            outcome = "the servo may keep its pulses ('fishctl estop' ends them) and"
        place = _format_place(sys._current_frames().get(self._main))
        line = (
            f"{name} came {SHUTDOWN_TIMEOUT_S:g} s ago, and fishd hangs {place}: {outcome} the "
            "process is ended"
        )
        _call_within(end - _FLUSH_TIMEOUT_S - time.monotonic(), partial(log.critical, "%s", line))
        _call_within(max(_FLUSH_TIMEOUT_S, end - time.monotonic()), self.last_words)
        os._exit(1)


def exit_now(status: int) -> NoReturn:
    """End the process without waiting for threads or for a reader of the output."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # None if it was closed before the start
            _call_within(_FLUSH_TIMEOUT_S, stream.flush)
    os._exit(status)


def _call_within(seconds: float, function: Callable[[], object]) -> bool:
    """Call a function in a thread; return whether it returned in time [s] without an error."""
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
    """Ignore the signal; it needs a handler to wake the thread that waits for it."""


def _format_place(frame: FrameType | None) -> str:
    """Return the place of a frame, in words."""
    if frame is None:
        return "somewhere"
    code = frame.f_code
    return text.line(f"in {code.co_name}, {code.co_filename}:{frame.f_lineno}")
