"""The end of the process: what asks for it, and that it comes soon, whatever hangs."""

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

from fishd import text

log = logging.getLogger(__name__)

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
PATIENCE = 2.0
"""Time from a signal until fishd no longer waits for an orderly end [s]."""
_RELEASE = 0.5
"""What the last resort may take to let go of the servo then [s]."""
_FLUSH = 0.1
"""What writing the rest of the output may take at the very end [s]."""


class Ending:
    """Listens for signals in a thread, which also ends the process when it hangs.

    A signal reaches this thread even where the main one is stuck, as long as that does not keep
    the interpreter to itself: then only SIGKILL helps, which systemd's watchdog sends.
    """

    def __init__(self) -> None:
        """Call it from the main thread. SIGHUP stays ignored where it is, as below `nohup`."""
        self._asked = threading.Event()
        self._tell: Callable[[], object] = lambda: None
        self.release: Callable[[], None] | None = None
        """Lets go of the servo, from any thread: called where fishd hangs; None while it starts."""
        self.last_words: Callable[[], None] = lambda: None
        """Writes what is left of the log, as far as that is possible at once."""
        self._main = threading.get_ident()
        self._reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in SIGNALS:
            if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, _noticed)
        threading.Thread(target=self._watch, name="ending", daemon=True).start()

    def when_asked(self, tell: Callable[[], object]) -> None:
        """Call that from the listening thread at the first signal; at once if there was one."""
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
        """Nothing here may wait: what hangs may hold any lock, that of logging too."""
        release = self.release
        if release:
            _within(_RELEASE, release)
        what = "the servo is released and" if release else "it has not begun to drive the servo;"
        place = _place(sys._current_frames().get(self._main))
        line = f"{name} came {PATIENCE:g} s ago, and fishd hangs {place}: "
        line += f"{what} the process is ended"
        _within(_FLUSH, partial(log.critical, "%s", line))
        _within(_FLUSH, self.last_words)
        os._exit(1)


def leave(status: int) -> NoReturn:
    """End the process without waiting for threads, or for somebody to read the output."""
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as where it was closed before the start
            _within(_FLUSH, stream.flush)
    os._exit(status)


def _within(seconds: float, function: Callable[[], object]) -> None:
    thread = threading.Thread(target=_quietly, args=(function,), daemon=True)
    thread.start()
    thread.join(seconds)


def _quietly(function: Callable[[], object]) -> None:
    with suppress(Exception):
        function()


def _noticed(number: int, frame: FrameType | None) -> None:
    """The thread that listens does the rest; without a handler it would hear nothing."""


def _place(frame: FrameType | None) -> str:
    """Where a thread is, in words."""
    if frame is None:
        return "somewhere"
    code = frame.f_code
    return text.line(f"in {code.co_name}, {code.co_filename}:{frame.f_lineno}")
