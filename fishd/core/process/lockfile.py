"""Lock files, each beside what only one process may use; it names that process.

The lock ends with its process, however that ends; a socket file stays. What another user has put
in place of the lock file, such as a link to another file, is left alone.
"""

import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_LOCKS = Path("/proc/locks")
"""File of the kernel that lists the locks and the processes that hold them."""
_CAREFULLY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


class Taken(Exception):
    """Another process holds the lock; `pid` is its number, or `unknown`."""

    def __init__(self, pid: str) -> None:
        super().__init__(f"held by process {pid}")
        self.pid = pid


class NotALock(OSError):
    """Something else has the name of the lock file; `strerror` says what."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(errno.EPERM, f"is {what}, no lock file of fishd", str(path))


def lock_path(path: Path) -> Path:
    """Where the lock file of `path` is."""
    return path.with_name(path.name + ".lock")


@contextmanager
def locked(path: Path, *, shared: bool = False, remove: bool = False) -> Iterator[None]:
    """Hold the lock file of `path`, and make it if it does not exist.

    shared: the group of the file may lock it, too, and another user may have made it
    remove: take the lock file away at the end, where that is permitted
    Raises `Taken` when a process holds it, this one included, OSError when it cannot be made,
    and `NotALock`, an OSError, where it is something else.
    """
    lock = _held(path, shared)
    try:
        os.ftruncate(lock, 0)
        os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        if remove:
            with suppress(OSError):
                lock_path(path).unlink()
        os.close(lock)


def holder(path: Path) -> str:
    """The pid of the process that holds the lock of `path`, or `unknown`; empty where none does.

    Asking takes the lock for a moment.
    """
    try:
        lock = _opened(lock_path(path), os.O_RDONLY, shared=True)
    except OSError:  # it was never held, or this user may not know
        return ""
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _pid_in(lock)
    finally:
        os.close(lock)
    return ""


def _held(path: Path, shared: bool) -> int:
    """The lock file, open and locked; tries again where its holder has just removed it."""
    while True:
        lock = _opened(lock_path(path), os.O_RDWR, shared=shared)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock), lock_path(path).lstat()):
                    return lock
        except BlockingIOError:
            pid = _pid_in(lock)
            os.close(lock)
            raise Taken(pid) from None
        except OSError:
            os.close(lock)
            raise
        os.close(lock)


def _opened(path: Path, flags: int, *, shared: bool) -> int:
    flags |= _CAREFULLY
    try:
        # First without O_CREAT: there, Linux refuses that for an existing file of another user.
        lock = os.open(path, flags)
    except FileNotFoundError:
        if flags & os.O_ACCMODE == os.O_RDONLY:
            raise
        lock = os.open(path, flags | os.O_CREAT, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise NotALock(path, "a symbolic link") from None
        raise
    found = os.fstat(lock)
    if what := _strange(found, path.parent, shared):
        os.close(lock)
        raise NotALock(path, what)
    # To open a file for reading is enough to lock it.
    mode = 0o660 if shared else 0o600
    if found.st_uid == os.geteuid() and stat.S_IMODE(found.st_mode) != mode:
        os.fchmod(lock, mode)
    return lock


def _strange(found: os.stat_result, folder: Path, shared: bool) -> str:
    """Why an open file is no lock file of fishd; empty where it is one."""
    if not stat.S_ISREG(found.st_mode):
        return "no regular file"
    if found.st_nlink > 1:
        return "another name of some file"
    owners = {os.geteuid(), 0, folder.stat().st_uid}
    if not shared and found.st_uid not in owners:
        return f"a file of user {found.st_uid}"
    return ""


def _pid_in(lock: int) -> str:
    """Return the pid of the process that holds the lock, by the kernel; else the one written there.

    What is written there may be old, or not true.
    """
    inode = str(os.fstat(lock).st_ino)
    with suppress(OSError):
        for line in _LOCKS.read_text(encoding="ascii").splitlines():
            fields = line.split()  # 1: FLOCK ADVISORY WRITE 4711 08:02:131090 0 EOF
            if fields[1] == "FLOCK" and fields[5].rpartition(":")[2] == inode:
                return fields[4]
    written = os.pread(lock, 20, 0).strip()
    return written.decode() if written.isdigit() else "unknown"
