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


class Attempt(Generic[T]):
    """A call in a separate thread that can be given up; the process does not wait for it to end.

    A call that never ends keeps its thread until the process ends.
    """

    def __init__(
        self,
        function: Callable[[], T],
        *,
        done: Callable[[], None] = lambda: None,
        late: Callable[[T], Any] = lambda result: None,
    ) -> None:
        """
        done: called in that thread when there is a result, unless the call was given up
        late: receives the result of a call that returns after it was given up
        """
        self._function = function
        self._done = done
        self._late = late
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
        """Give up the call; return False if it has finished."""
        with self._settling:
            self._given_up = not self._settled.is_set()
            return self._given_up

    def _run(self) -> None:
        if self._given_up:
            return
        try:
            self._result.append(call_foreign(self._function))
        except Exception as error:
            self._error = error
        with self._settling:
            if not self._given_up:
                self._settled.set()
        if self._settled.is_set():
            self._done()
            return
        self._error = None  # no caller will read it
        if self._result:
            with suppress(Exception):
                call_foreign(self._late, self._result[0])
