"""Lock files, each next to a resource that only one process may use; they contain its pid.

Unlike a socket file, the lock ends with its process, however that ends. If another user has put
something in place of the lock file, such as a link to another file, that is not touched.
"""

import errno
import fcntl
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

RETRY_PERIOD_S = 0.02
"""Time between two attempts to take a lock [s]."""
_KERNEL_LOCKS = Path("/proc/locks")
"""The kernel's list of locks and the processes that hold them."""
_SAFE_OPEN_FLAGS = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


class LockHeld(Exception):
    """Another process holds the lock; `pid` is its id, or `unknown`."""

    def __init__(self, pid: str) -> None:
        super().__init__(f"held by process {pid}")
        self.pid = pid


class NotALock(OSError):
    """The path of the lock file belongs to something else, which `strerror` describes."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(errno.EPERM, f"is {what}, not a lock file of fishd", str(path))


def lock_path(path: Path) -> Path:
    """Return the path of the lock file of `path`."""
    return path.with_name(path.name + ".lock")


@contextmanager
def locked(path: Path, *, remove: bool = False, timeout: float = 0.0) -> Iterator[None]:
    """Hold the lock of `path`, and create the lock file if it does not exist.

    remove: remove the lock file at the end, if that is permitted
    timeout: longest wait for a process that holds it [s]
    Raise `LockHeld` if a process holds it, this one included, OSError if it cannot be created, and
    `NotALock`, an OSError, if the path is something else.
    """
    deadline = time.monotonic() + timeout
    while True:
        try:
            lock = _acquire_lock(path)
            break
        except LockHeld:
            if time.monotonic() >= deadline:
                raise
            time.sleep(RETRY_PERIOD_S)
    try:
        os.ftruncate(lock, 0)
        os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        if remove:
            with suppress(OSError):
                lock_path(path).unlink()
        os.close(lock)


def find_lock_holder(path: Path) -> str | None:
    """Return the pid of the process that holds the lock of `path`, or `unknown`; None if none.

    The check holds the lock for a moment.
    """
    try:
        lock = _open_lock(lock_path(path), os.O_RDONLY)
    except OSError:  # it was never held, or this user may not read it
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _read_pid(lock)
    finally:
        os.close(lock)
    return None


def _acquire_lock(path: Path) -> int:
    """Return the lock file, open and locked; retry if its holder has just removed it."""
    while True:
        lock = _open_lock(lock_path(path), os.O_RDWR)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock), lock_path(path).lstat()):
                    return lock
        except BlockingIOError:
            pid = _read_pid(lock)
            os.close(lock)
            raise LockHeld(pid) from None
        except OSError:
            os.close(lock)
            raise
        os.close(lock)


def _open_lock(path: Path, flags: int) -> int:
    flags |= _SAFE_OPEN_FLAGS
    try:
        # First without O_CREAT, which Linux may refuse for an existing file of another user.
        lock = os.open(path, flags)
    except FileNotFoundError:
        if flags & os.O_ACCMODE == os.O_RDONLY:
            raise
        lock = os.open(path, flags | os.O_CREAT, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise NotALock(path, "a symbolic link") from None
        raise
    status = os.fstat(lock)
    if problem := _find_lock_problem(status, path.parent):
        os.close(lock)
        raise NotALock(path, problem)
    # Read permission is enough to lock a file.
    if status.st_uid == os.geteuid() and stat.S_IMODE(status.st_mode) != 0o600:
        os.fchmod(lock, 0o600)
    return lock


def _find_lock_problem(status: os.stat_result, folder: Path) -> str | None:
    """Return why an open file is not a lock file of fishd; None if it is one."""
    if not stat.S_ISREG(status.st_mode):
        return "not a regular file"
    if status.st_nlink > 1:
        return "a hard link to another file"
    owners = {os.geteuid(), 0, folder.stat().st_uid}
    if status.st_uid not in owners:
        return f"a file of user {status.st_uid}"
    return None


def _read_pid(lock: int) -> str:
    """Return the pid of the process that holds the lock: from the kernel, else from the file.

    The pid in the file may be outdated, or false.
    """
    inode = str(os.fstat(lock).st_ino)
    with suppress(OSError):
        for line in _KERNEL_LOCKS.read_text(encoding="ascii").splitlines():
            fields = line.split()  # 1: FLOCK ADVISORY WRITE 4711 08:02:131090 0 EOF
            if fields[1] == "FLOCK" and fields[5].rpartition(":")[2] == inode:
                return fields[4]
    written = os.pread(lock, 20, 0).strip()
    return written.decode() if written.isdigit() else "unknown"
