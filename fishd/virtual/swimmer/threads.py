"""A second thread for the halves of a step on a large grid.

Most work of a step is a pair of equal, independent tasks: u and v, or even and odd modes.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from numba import config

MIN_CELLS = 150_000
"""Number of cells from which a second thread saves more time than it takes to wake it."""


class Pairs:
    """Runs two tasks at a time, or one after the other; results are the same."""

    def __init__(self, cells: int) -> None:
        """cells: size of the grid

        The environment variable NUMBA_NUM_THREADS limits the number of threads; joblib sets it in
        each of the processes that run at a time.
        """
        self.has_two_threads = cells >= MIN_CELLS and config.NUMBA_NUM_THREADS > 1
        self._other = ThreadPoolExecutor(1, "fishd-swimmer") if self.has_two_threads else None

    def run(self, first: Callable[[], Any], second: Callable[[], Any]) -> tuple[Any, Any]:
        """Return the results of both tasks, after both have ended."""
        if self._other is None:
            return first(), second()
        waiting = self._other.submit(second)
        try:
            result = first()
        finally:
            other = waiting.result()
        return result, other
