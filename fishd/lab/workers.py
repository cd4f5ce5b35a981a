"""The interface of parallel workers: processes on this machine, or those of a cluster."""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar

from fishd.core.errors import FishdError

T = TypeVar("T")
R = TypeVar("R")


class Unfinished(FishdError):
    """The processes or the cluster were lost; `unfinished` are the indices of the tasks left."""

    def __init__(self, message: str, unfinished: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.unfinished = unfinished


class Stop(Protocol):
    """A signal to stop, which is passed to tasks in all processes and on all machines."""

    def make_check(self) -> Callable[[], bool]:
        """Return a function, for use in a task, that returns whether to stop."""


class Workers(Protocol):
    """Processes that compute; see `fishd.lab.parallel.workers`."""

    @property
    def stop(self) -> Stop:
        """Signal of `ask_to_stop`, for tasks."""

    def ask_to_stop(self) -> None:
        """Tell all tasks to stop, also those that have not started; returns immediately."""

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield index and result of each task, in the order in which they end.

        function: function at the top level of a module; its argument and result are pickled

        Tasks are restarted after a process was killed. After `ask_to_stop` this may end without
        the results of some tasks. Raises `Unfinished`, and what a task raises on this machine.
        """
