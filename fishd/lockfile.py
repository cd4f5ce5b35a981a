"""A lock file beside what only one process may use; it names the process that holds it.

The lock ends with its process, however that ends: unlike a socket file it never lies.
"""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


class Taken(Exception):
    """Another process holds the lock; `pid` is its number, or `unknown`."""

    def __init__(self, pid: str) -> None:
        super().__init__(f"held by process {pid}")
        self.pid = pid


def lock_path(path: Path) -> Path:
    """Where the lock file of `path` is."""
    return path.with_name(path.name + ".lock")


@contextmanager
def locked(path: Path, opener: Callable[[str, int], int] | None = None) -> Iterator[None]:
    """Hold the lock file of `path`, and make it where there is none.

    opener: as for `open`, where the file must not be made in the usual way
    Raises `Taken` when somebody holds it, OSError when it cannot be made.
    """
    with open(lock_path(path), "a+", encoding="ascii", opener=opener) as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise Taken(lock.read().strip() or "unknown") from None
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        yield  # the lock file stays: to remove it would let two processes hold two of them
