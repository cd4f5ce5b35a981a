"""File of a recording in progress: `<run>.mcap.part`, complete chunks only, renamed at the end."""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fishd.core import files
from fishd.core.errors import RecordingError

PART_SUFFIX = ".part"
SUFFIX = ".mcap"
MAX_BUFFERED_BYTES = 2**18
"""Maximum amount of data in memory, for runs in virtual time, which are not flushed [bytes]."""


class PartFile:
    """File that writes each flush completely or not at all, so that a full disk does not damage it.

    It has the methods of a Python file that the MCAP writer needs. It is locked while it is open,
    which distinguishes it from an abandoned one.
    """

    def __init__(self, path: Path, part: Path | None = None) -> None:
        """
        path: path of the finished file
        part: path until then; by default with `.part` added

        Raises `RecordingError` if either exists or cannot be created.
        """
        self.final = path
        self.path = part or path.with_name(path.name + PART_SUFFIX)
        if os.path.lexists(path):
            raise RecordingError(f"{path} already exists; choose another name")
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._fd = os.open(self.path, flags, 0o666)
        except FileExistsError:
            raise RecordingError(
                f"{self.path} already exists, from a recording in progress or not finished; "
                f"choose another name, or see 'fishctl recover {self.path}'"
            ) from None
        except OSError as error:
            raise RecordingError(f"{self.path} cannot be written: {error.strerror}") from None
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        self._waiting = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        """Store complete records for the next flush, or flush at once; then raise OSError."""
        self._waiting += data
        if len(self._waiting) > MAX_BUFFERED_BYTES:
            self.flush()
        return len(data)

    def tell(self) -> int:
        """Return the size of the file, unflushed data included [bytes]."""
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Write all unflushed data to the kernel, or none of it; raise OSError."""
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
        """Wait until flushed data are safe against a power cut, too; raise OSError."""
        os.fdatasync(self._fd)

    def free(self) -> int:
        """Return the free space on the disk for this user [bytes]."""
        file_system = os.fstatvfs(self._fd)
        return file_system.f_bavail * file_system.f_frsize

    def finish(self) -> None:
        """Give the file its final name; raise OSError, and then keep the part."""
        self.sync()
        rename_to_final(self.path, self.final)

    def remove(self) -> None:
        """Remove the part."""
        self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def rename_to_final(part: Path, final: Path) -> None:
    """Rename a complete file, never onto another file; raise OSError, and then change nothing.

    A kill during the rename may leave both names for the same file.
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
def lock_recording(path: Path) -> Iterator[None]:
    """Lock a recording as one in progress, if its file system can do so; raise OSError."""
    with path.open("rb") as file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def is_being_written(path: Path) -> bool:
    """Return whether a process writes or recovers this part."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
