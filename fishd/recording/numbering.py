"""Running numbers of recordings and experiments, which give their order.

Neither a modification time nor a date decides: both follow the unix clock, which may be wrong.
"""

import fcntl
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from fishd.core.errors import RecordingError
from fishd.recording.mcap_file import read_first_metadata
from fishd.recording.part_file import PART_SUFFIX, SUFFIX

COUNTER_FILE = ".fishd-number"
"""File of a folder with the largest number given there, so that none is given twice."""
MAX_LOCK_WAIT_S = 2.0
"""Longest wait for another process that holds the lock of that file, as a stopped one does [s]."""
_WIDTH = 18
"""Number of digits in that file, always the same: a full disk can replace them, too."""


def next_number(folder: Path, known: Iterable[int]) -> int:
    """Return a number above all that were given in a folder, whatever was deleted since.

    known: numbers there, also of files from another machine; if the counter file cannot be locked,
    read or written, they alone decide
    """
    number = max(known, default=0) + 1
    with suppress(OSError):
        descriptor = os.open(folder / COUNTER_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        with os.fdopen(descriptor, "r+b", buffering=0) as file:
            _lock(file.fileno())
            number = max(number, parse_number(os.pread(descriptor, _WIDTH, 0)) + 1)
            os.pwrite(descriptor, b"%0*d\n" % (_WIDTH, number), 0)
            os.fsync(descriptor)
    return number


def _lock(descriptor: int) -> None:
    """Lock a file, or raise OSError if another process holds its lock for too long."""
    deadline = time.monotonic() + MAX_LOCK_WAIT_S
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > deadline:
                raise
        time.sleep(0.01)


def parse_number(digits: str | bytes) -> int:
    """Return a running number; 0 if there is none."""
    is_number = digits.isdigit() and digits.isascii() and len(digits) <= _WIDTH
    return int(digits) if is_number else 0


def list_files(folder: Path, prefix: str = "") -> list[Path]:
    """Return the recordings of a folder, finished or not; raise `RecordingError`.

    prefix: beginning of their names
    """
    try:
        ending = (
            path
            for path in folder.iterdir()
            if path.name.startswith(prefix) and path.name.endswith((SUFFIX, SUFFIX + PART_SUFFIX))
        )
        return [path for path in ending if path.is_file()]  # reading a pipe would never end
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordingError(f"{folder} cannot be read: {error.strerror}") from None


def next_recording_number(folder: Path) -> int:
    """Return the number of a recording that begins now."""
    known: list[Path] = []
    with suppress(RecordingError):
        known = list_files(folder)
    return next_number(folder, map(read_number, known))


def read_number(path: Path) -> int:
    """Return the number of a recording; 0 for an older one, or if its beginning is damaged."""
    try:
        return parse_number(read_first_metadata(path).get("number", ""))
    except RecordingError:
        return 0
