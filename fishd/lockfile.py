"""A lock file beside what only one process may use; it names the process that holds it.

The lock ends with its process, however that ends: unlike a socket file it never lies.
"""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO


class Taken(Exception):
    """Somebody holds the lock; `pid` is the number of that process, or `unknown`."""

    def __init__(self, pid: str) -> None:
        super().__init__(f"held by process {pid}")
        self.pid = pid


def lock_path(path: Path) -> Path:
    """Where the lock file of `path` is."""
    return path.with_name(path.name + ".lock")


@contextmanager
def locked(
    path: Path, opener: Callable[[str, int], int] | None = None, *, remove: bool = False
) -> Iterator[None]:
    """Hold the lock file of `path`, and make it where there is none.

    opener: as for `open`, where the file must not be made in the usual way
    remove: take the lock file away at the end, where that is permitted
    Raises `Taken` when somebody holds it, this process included, OSError when it cannot be made.
    """
    with _held(path, opener) as lock:
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        try:
            yield
        finally:
            if remove:
                with suppress(OSError):
                    lock_path(path).unlink()


def _held(path: Path, opener: Callable[[str, int], int] | None) -> TextIO:
    """The lock file, locked; not one that its holder has removed meanwhile."""
    while True:
        lock = open(lock_path(path), "a+", encoding="ascii", opener=opener)  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock.fileno()), lock_path(path).stat()):
                    return lock
        except BlockingIOError:
            lock.seek(0)
            pid = lock.read().strip() or "unknown"
            lock.close()
            raise Taken(pid) from None
        except OSError:
            lock.close()
            raise
        lock.close()
