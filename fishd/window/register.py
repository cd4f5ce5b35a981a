"""The windows that run.

Each window has a file in its state folder, which is locked while the window lives. By it, `fishctl
window` finds the window.
"""

import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from os import getpid
from pathlib import Path

import msgspec
from msgspec import Struct

from fishd.core import files
from fishd.core.decoding import decoder
from fishd.core.errors import StartupError
from fishd.core.files import write_atomically
from fishd.core.process.lockfile import LockHeld, find_lock_holder, lock_path, locked
from fishd.window.settings import WindowSettings

MAX_FILE_BYTES = 2**20
CLOSE_TIMEOUT_S = 1.0
"""Longest wait for the disk at the end [s]; a later window removes what stays."""
_PATTERN, _SCRATCH_SUFFIX = "window-*.json", ".scratch"


class RunningWindow(Struct, frozen=True):
    """Entry of a window in the register."""

    listen: str
    """Address at which it listens, such as `0.0.0.0:8880`."""
    names: tuple[str, ...] = ()
    """Further host names by which browsers reach it."""


_decode: Callable[[bytes], RunningWindow] = decoder(RunningWindow)


class Register:
    """The entry of this window; a context manager."""

    def __init__(self, folder: Path) -> None:
        """folder: state folder, which exists"""
        self._path = folder / f"window-{getpid()}.json"
        self.scratch = self._path.with_suffix(_SCRATCH_SUFFIX)
        """Folder that is removed at the end, or with the next window if this one is killed."""
        self._stack = ExitStack()

    def __enter__(self) -> "Register":
        try:
            self._stack.enter_context(locked(self._path, remove=True))
            self.scratch.mkdir(mode=0o700, exist_ok=True)
        except (OSError, LockHeld) as error:
            raise StartupError(f"{lock_path(self._path)} cannot be locked: {error}") from None
        self._stack.callback(self._path.unlink, missing_ok=True)
        self._stack.callback(shutil.rmtree, self.scratch, ignore_errors=True)
        return self

    def __exit__(self, *_: object) -> None:
        # A disk may be slow: a later window removes what stays.
        closing = threading.Thread(target=self._stack.close, daemon=True)
        closing.start()
        closing.join(CLOSE_TIMEOUT_S)

    def write(self, entry: RunningWindow) -> None:
        """Write the entry; on a full disk, there is none."""
        with suppress(OSError):
            write_atomically(self._path, msgspec.json.encode(entry))


def find_running(folder: Path) -> list[RunningWindow]:
    """Return the windows that run, those that the network reaches first."""
    running = [entry for path, entry in _read_entries(folder) if find_lock_holder(path)]
    return sorted(running, key=lambda entry: WindowSettings(listen=entry.listen).is_local)


def remove_killed(folder: Path) -> None:
    """Remove the entries and folders of the windows that were killed."""
    for scratch in folder.glob(f"window-*{_SCRATCH_SUFFIX}"):
        if not find_lock_holder(scratch.with_suffix(".json")):
            shutil.rmtree(scratch, ignore_errors=True)
    for path, _ in _read_entries(folder):
        if not find_lock_holder(path):
            path.unlink(missing_ok=True)
            lock_path(path).unlink(missing_ok=True)


def _read_entries(folder: Path) -> Iterator[tuple[Path, RunningWindow]]:
    """Yield the entries that can be read, of windows that run or do not."""
    paths: Sequence[Path] = []
    with suppress(OSError):  # there is no such folder, or this user may not read it
        paths = sorted(folder.glob(_PATTERN))
    for path in paths:
        with suppress(files.FileProblem, msgspec.DecodeError):
            yield path, _decode(files.read(path, MAX_FILE_BYTES, "a running window"))
