"""How code of other packages is called, such as a controller's or a driver's.

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


def contained(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function; whatever it raises is an `Exception`, if need be an `Escaped`.

    Only a true Ctrl-C passes: a KeyboardInterrupt where Python raises it for SIGINT, as it does in
    `fishctl`, not in the daemon.
    """
    try:
        return function(*args, **kwargs)
    except (StopIteration, StopAsyncIteration) as error:  # which no coroutine may raise
        raise Escaped(text.named(error)) from error
    except Exception:
        raise
    except BaseException as error:
        if isinstance(error, Interrupted) or (
            isinstance(error, KeyboardInterrupt) and _ctrl_c_is_raised()
        ):
            raise
        raise Escaped(text.named(error)) from error


def _ctrl_c_is_raised() -> bool:
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def real_number(value: Any, what: str) -> float:
    """A real number as a float; raises ValueError for what is none, such as a text or True.

    what: what it is called in the error
    """
    try:
        # An array of one number, whatever its shape, or one of numpy's own kinds of number.
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
    """A call in a thread of its own, which can be given up. The process does not wait for it."""

    def __init__(
        self,
        function: Callable[[], T],
        *,
        done: Callable[[], None] = lambda: None,
        late: Callable[[T], Any] = lambda result: None,
        interrupt: bool = True,
    ) -> None:
        """
        done: called in that thread as soon as there is a result, unless the call was given up
        late: takes the result of a call that was given up and returned after all
        interrupt: end a loop in Python when the call is given up; False where that would do harm
        """
        self._function = function
        self._done = done
        self._late = late
        self._interrupt = interrupt
        self._begun = False
        """Is the thread in code that `GivenUp` may end? Not in that of `threading` at its start."""
        self._result: list[T] = []
        self._error: Exception | None = None
        self._settling = threading.Lock()
        self._settled = threading.Event()
        self._given_up = False
        self._thread = threading.Thread(target=self._run, name="background call", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Does the thread still run?"""
        return self._thread.is_alive()

    def wait(self, seconds: float) -> bool:
        """Wait for the result; False when it has not come in that time."""
        return self._settled.wait(seconds)

    def result(self) -> T:
        """What the function returned; raises what it raised, once. Only when it is `done`."""
        error, self._error = self._error, None
        try:
            if error:
                raise error
            return self._result[0]
        finally:
            del error  # its traceback leads here: a cycle would keep what the function had read

    def give_up(self) -> bool:
        """End a loop in Python, and leave alone what cannot be ended; False if it is done."""
        with self._settling:
            if self._settled.is_set():
                return False
            if not self._given_up:
                self._given_up = True
                self._raise_in_thread(GivenUp)
        return True

    def _raise_in_thread(self, error: Any) -> None:
        """Raise there, as soon as it is in Python; None takes back what was not raised yet."""
        if not (self._interrupt and self._begun):
            return
        import ctypes  # only where a call is given up

        error = ctypes.py_object(error) if error else None
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._thread.ident or 0), error)

    def _run(self) -> None:
        try:
            in_time = self._attempt()
        except GivenUp:
            in_time = False
        if in_time:
            self._done()
        elif self._result:
            with suppress(Exception):
                contained(self._late, self._result[0])

    def _attempt(self) -> bool:
        """Call the function; True unless it was given up before or meanwhile."""
        with self._settling:
            if self._given_up and self._interrupt:
                return False
            self._begun = True
        try:
            self._result.append(contained(self._function))
        except Exception as error:
            self._error = error
        with self._settling:
            if self._given_up:
                self._error = None  # nobody asks for it
                self._raise_in_thread(None)
            else:
                self._settled.set()
            return not self._given_up
