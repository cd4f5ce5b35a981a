"""The file while it is written: `<run>.mcap.part`, whole chunks only, renamed when it is whole."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fishd.core import files
from fishd.core.errors import RecordingError

PART = ".part"
SUFFIX = ".mcap"
MOST_WAITING = 2**18
"""What a run in virtual time, which nobody flushes, keeps in memory at most [bytes]."""


class PartFile:
    """Writes whole flushes or nothing: a full disk leaves what was flushed before, whole.

    It has as much of a Python file as the MCAP writer needs. It is locked while it is open, so that
    nobody mistakes it for one that was left behind.
    """

    def __init__(self, path: Path, part: Path | None = None) -> None:
        """
        path: of the finished file
        part: its name until then; by default `.part` is added

        Raises `RecordingError` where either exists or cannot be made.
        """
        self.final = path
        self.path = part or path.with_name(path.name + PART)
        if os.path.lexists(path):
            raise RecordingError(f"{path} is there already; choose another name")
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._fd = os.open(self.path, flags, 0o666)
        except FileExistsError:
            raise RecordingError(
                f"{self.path} is there already, of a recording that runs or was not finished; "
                f"choose another name, or see 'fishctl recover {self.path}'"
            ) from None
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be written: {error.strerror}") from None
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        self._waiting = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        """Take whole records for the next flush; raises OSError where that is due at once."""
        self._waiting += data
        if len(self._waiting) > MOST_WAITING:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """How long the file is, with what waits [bytes]."""
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Hand all that waits to the kernel, or none of it; raises OSError."""
        view, done = memoryview(bytes(self._waiting)), 0
        try:
            while done < len(view):
                done += os.write(self._fd, view[done:])
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self._written)
                os.lseek(self._fd, self._written, os.SEEK_SET)
            raise
        self._written += done
        self._waiting.clear()

    def sync(self) -> None:
        """Wait until what was flushed survives a power cut, too; raises OSError."""
        os.fdatasync(self._fd)

    def free(self) -> int:
        """Room left on the disk, for this user [bytes]."""
        found = os.fstatvfs(self._fd)
        return found.f_bavail * found.f_frsize

    def finish(self) -> None:
        """Give the file its final name; raises OSError, and leaves the part where it is then."""
        self.sync()
        give_name(self.path, self.final)

    def remove(self) -> None:
        """Take the part away."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close it; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def give_name(part: Path, final: Path) -> None:
    """Rename what is whole, never onto another file; raises OSError, and leaves it as it was then.

    A kill in the midst of it may leave both names, of the same file.
    """
    try:
        final.hardlink_to(part)  # unlike a rename, never onto another file
    except OSError as error:
        if error.errno == errno.EEXIST or final.exists():
            raise
        part.rename(final)  # a file system without links, such as that of USB sticks
    else:
        part.unlink()
    files.sync_folder(final.parent)


@contextmanager
def held(path: Path) -> Iterator[None]:
    """Lock a recording as one that is being written, where its file system can; raises OSError."""
    with path.open("rb") as file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def is_being_written(path: Path) -> bool:
    """Does some process still write this part, or recover it?"""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
