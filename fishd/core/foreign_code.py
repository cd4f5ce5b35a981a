"""Calls of code of other packages, such as a controller's or a driver's.

Such code may raise anything, and may never return.
"""

import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Generic, ParamSpec, TypeVar

from fishd.core import text
from fishd.core.errors import Escaped
from fishd.core.process.interruption import Interrupted

P = ParamSpec("P")
T = TypeVar("T")


def call_foreign(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function; convert whatever it raises that is not an `Exception` to `Escaped`.

    Only a true Ctrl-C passes: a KeyboardInterrupt where Python raises it for SIGINT, which is so in
    `fishctl`, but not in the daemon.
    """
    try:
        return function(*args, **kwargs)
    except (StopIteration, StopAsyncIteration) as error:  # not permitted in a coroutine
        raise Escaped(text.describe_error(error)) from error
    except Exception:
        raise
    except BaseException as error:
        if isinstance(error, Interrupted) or (
            isinstance(error, KeyboardInterrupt) and _ctrl_c_is_raised()
        ):
            raise
        raise Escaped(text.describe_error(error)) from error


def _ctrl_c_is_raised() -> bool:
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def real_number(value: Any, what: str) -> float:
    """Return a real number as a float; raise ValueError for anything else, such as a text or True.

    what: name of the number in the error
    """
    try:
        # An array of one number, of any shape, or a numpy scalar.
        number = value.item() if hasattr(value, "item") else value
        if not isinstance(number, bool | str | bytes | bytearray):
            return float(number)
    except (TypeError, ValueError, OverflowError):
        pass
    kind = text.quoted(type(value).__name__)
    raise ValueError(f"{what} is of type {kind}, not one real number")


class GivenUp(BaseException):
    """Raised in the thread of an `Attempt` that was given up."""


class Attempt(Generic[T]):
    """A call in a separate thread that can be given up; the process does not wait for it to end."""

    def __init__(
        self,
        function: Callable[[], T],
        *,
        done: Callable[[], None] = lambda: None,
        late: Callable[[T], Any] = lambda result: None,
        interrupt: bool = True,
    ) -> None:
        """
        done: called in that thread when there is a result, unless the call was given up
        late: receives the result of a call that returns after it was given up
        interrupt: end a loop in Python when the call is given up; False where that is unsafe
        """
        self._function = function
        self._done = done
        self._late = late
        self._interrupt = interrupt
        self._begun = False
        """Whether the thread is in code that `GivenUp` may end, past the start code of
        `threading`."""
        self._result: list[T] = []
        self._error: Exception | None = None
        self._settling = threading.Lock()
        self._settled = threading.Event()
        self._given_up = False
        self._thread = threading.Thread(target=self._run, name="background call", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    def wait(self, seconds: float) -> bool:
        """Wait for the result; return False if there is none in that time."""
        return self._settled.wait(seconds)

    def result(self) -> T:
        """Return the result of the function, or raise its error, once; only after `done`."""
        error, self._error = self._error, None
        try:
            if error:
                raise error
            return self._result[0]
        finally:
            # Its traceback refers to this frame: the cycle would keep the function's data alive.
            del error

    def give_up(self) -> bool:
        """Give up the call, and end a loop in Python; return False if the call has finished."""
        with self._settling:
            if self._settled.is_set():
                return False
            if not self._given_up:
                self._given_up = True
                if self._interrupt and self._begun:
                    _raise_in(self._thread)
        return True

    def _run(self) -> None:
        try:
            in_time = self._attempt()
        except GivenUp:
            in_time = False
        if in_time:
            self._done()
        elif self._result:
            with suppress(Exception):
                call_foreign(self._late, self._result[0])

    def _attempt(self) -> bool:
        """Call the function; return False if the call was given up before or during it."""
        with self._settling:
            if self._given_up and self._interrupt:
                return False
            self._begun = True
        try:
            self._result.append(call_foreign(self._function))
        except Exception as error:
            self._error = error
        with self._settling:
            if self._given_up:
                self._error = None  # no caller will read it
                if self._interrupt:
                    _receive_pending()
            else:
                self._settled.set()
            return not self._given_up


def _raise_in(thread: threading.Thread) -> None:
    """Raise `GivenUp` in a thread at its next Python code."""
    import ctypes  # slow to import, and only needed when a call is given up

    ident = ctypes.c_ulong(thread.ident or 0)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ident, ctypes.py_object(GivenUp))


def _receive_pending() -> None:
    """Receive a `GivenUp` that may still be pending in this thread, or one like it.

    A pending error that is only cancelled leaves Python in a state in which each call of a function
    takes longer, and one that is traced never ends (Python 3.11).
    """
    with suppress(GivenUp):
        _raise_in(threading.current_thread())
        while True:
            pass
