"""A second thread for the halves of a step on a large grid.

Most work of a step is a pair of equal, independent tasks: u and v, or even and odd modes.
"""

import threading
import weakref
from collections.abc import Callable
from typing import Any

from numba import config

MIN_CELLS = 150_000
"""Number of cells from which a second thread saves more time than it takes to wake it."""


class Pairs:
    """Runs two tasks at a time, or one after the other; results are the same.

    The second thread ends with this object.
    """

    def __init__(self, cells: int) -> None:
        """cells: size of the grid

        The environment variable NUMBA_NUM_THREADS limits the number of threads; joblib sets it in
        each of the processes that run at a time.
        """
        self._thread = None
        if cells >= MIN_CELLS and config.NUMBA_NUM_THREADS > 1:
            self._thread = _Thread()
            weakref.finalize(self, self._thread.run, None)

    def run(self, first: Callable[[], Any], second: Callable[[], Any]) -> tuple[Any, Any]:
        """Return the results of both tasks, which raise no errors."""
        if self._thread is None:
            return first(), second()
        self._thread.run(second)
        return first(), self._thread.wait()


class _Thread:
    """Thread that runs one task after the other; two locks are the fastest way to wake it."""

    def __init__(self) -> None:
        self._task: Callable[[], Any] | None = None
        self._result: Any = None
        self._begin, self._end = threading.Lock(), threading.Lock()
        self._begin.acquire()
        self._end.acquire()
        threading.Thread(target=self._loop, name="fishd-swimmer", daemon=True).start()

    def run(self, task: Callable[[], Any] | None) -> None:
        """Begin a task; None: end the thread."""
        self._task = task
        self._begin.release()

    def wait(self) -> Any:
        """Wait until the task has ended, and return its result."""
        self._end.acquire()
        return self._result

    def _loop(self) -> None:
        while self._begin.acquire():
            # Keeps no reference to the task, which refers to the grid.
            task, self._task = self._task, None
            if task is None:
                return
            self._result = task()
            del task
            self._end.release()
