"""Unix sockets: finding and checking their listener, and replacing abandoned ones.

In /tmp any user can create the folder of fishd's socket, and answer there.
"""

import errno
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from fishd.core.errors import StartupError
from fishd.core.process.kernel_names import Holder, NameTaken, claimed, read_listener

MAX_PATH_BYTES = 107
"""Maximum length of the path of a Unix socket in Linux [bytes]."""
RELEASE_TIMEOUT_S, RETRY_INTERVAL_S = 1.0, 0.02
"""Maximum time for the gateways of a killed fishd to end, and the interval of retries [s]."""
GROUP_MASK = 0o117
"""Umask of a socket to which only the user and the group of this process may connect."""
_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_ROOT = 0


def check_length(path: str) -> None:
    """Raise ValueError if the path is too long for a Unix socket."""
    length = len(os.fsencode(path))
    if length > MAX_PATH_BYTES:
        raise ValueError(
            f"the path of a Unix socket has at most {MAX_PATH_BYTES} bytes, this one has {length}; "
            "choose a shorter one, such as in /run or /tmp"
        )


def find_trust_problem(path: Path) -> str | None:
    """Return why this user must not trust the server at `path`; None if it can be trusted.

    Trusted users are this user, root, and the owner of a folder that only root can have created for
    them, such as /run/fishd for the service. No other user may write to the folder or listen there.
    None also if there is no socket.
    """
    folder = path.parent
    try:
        folder_status, parent_status = folder.lstat(), folder.parent.stat()
    except OSError:
        return None
    if stat.S_ISLNK(folder_status.st_mode) and not _only_root_may_write(parent_status):
        return f"{folder} is a symbolic link"
    folder_status = folder.stat() if stat.S_ISLNK(folder_status.st_mode) else folder_status
    trusted = {os.geteuid(), _ROOT}
    if _only_root_may_write(parent_status):
        trusted.add(folder_status.st_uid)
    if folder_status.st_uid not in trusted:
        return f"{folder} belongs to user {folder_status.st_uid}"
    if folder_status.st_mode & _WRITABLE_BY_OTHERS:
        return f"other users may write to {folder}"
    with suppress(PermissionError):
        listener = find_listener(path)
        if listener and listener.user not in trusted:
            return f"a process of user {listener.user} listens there"
    return None


def is_open_to_all(folder: Path) -> bool:
    """Return whether every user may remove the files of others in a folder."""
    try:
        mode = folder.stat().st_mode
    except OSError:
        return False
    return bool(mode & stat.S_IWOTH and not mode & stat.S_ISVTX)


def _only_root_may_write(folder: os.stat_result) -> bool:
    return folder.st_uid == _ROOT and not folder.st_mode & _WRITABLE_BY_OTHERS


def find_listener(path: Path) -> Holder | None:
    """Return the listener of a socket; None if there is none, or it cannot accept now.

    Raise PermissionError if this user may not connect.
    """
    with socket.socket(socket.AF_UNIX) as probe:
        failure = _connect(probe, path)
        if failure == errno.EACCES:
            raise PermissionError(failure, os.strerror(failure), os.fspath(path))
        return None if failure else read_listener(probe)


def is_deserted(path: Path) -> bool:
    """Return whether it is certain that no process listens on a socket; does not block."""
    with socket.socket(socket.AF_UNIX) as probe:
        failure = _connect(probe, path)
    return failure in (errno.ENOENT, errno.ENOTDIR, errno.ECONNREFUSED)


def _connect(probe: socket.socket, path: Path) -> int:
    """Connect without blocking; return 0 or the errno of the failure."""
    probe.setblocking(False)
    try:
        return probe.connect_ex(os.fspath(path))
    except OSError:  # the path is too long for a socket
        return errno.ENOENT


@contextmanager
def claim_socket(path: Path, name: str, rival: str, advice: str) -> Iterator[None]:
    """Make sure that no other process serves this socket, and remove its file at the end.

    Binding alone is not enough: ZeroMQ replaces the socket file of a running process, and leaves
    its own behind. The claim is a name in the kernel, which stays when the folder is removed.

    name: name of the socket in messages
    Raise `StartupError` with `rival` and `advice` if a process, even this one, serves the socket.
    """
    with ExitStack() as stack:
        try:
            if path.exists() and not path.is_socket():
                raise StartupError(f"{path} exists and is not a socket; choose another address")
            path.parent.stat()
            if not os.access(path.parent, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            stack.enter_context(claimed(_claim_name(path)))
        except NameTaken as taken:
            raise StartupError(
                f"{rival} (pid {taken.holder}) already serves {name}; {advice}"
            ) from None
        except OSError as error:
            raise StartupError(
                f"{path} cannot be created: {error.strerror}; choose an address in a folder that "
                "exists and that you may write to"
            ) from None
        deadline = time.monotonic() + RELEASE_TIMEOUT_S
        while path.is_socket() and not is_deserted(path):
            if time.monotonic() > deadline:  # a program without such a name
                raise StartupError(f"another program already serves {name}; {advice}")
            time.sleep(RETRY_INTERVAL_S)
        stack.callback(_remove_file, path)
        yield


def _claim_name(path: Path) -> str:
    """Return the name in the kernel for a path, the same for all links to it.

    Processes in containers may have another folder of the same name.
    """
    file_systems = Path("/proc/self/ns/mnt").stat().st_ino
    return f"serves/{file_systems}{path.resolve()}"


def _remove_file(path: Path) -> None:
    with suppress(OSError):  # its folder may be gone, or be another user's
        path.unlink()


def bind(server: socket.socket, path: Path, mask: int | None = None) -> None:
    """Bind a socket at a path held by `claim_socket`, and replace the file of a killed process.

    mask: umask for the socket, which decides which users may connect; None for that of the process
    Raise OSError.
    """
    path.unlink(missing_ok=True)
    before = os.umask(mask) if mask is not None else None
    try:
        server.bind(os.fspath(path))
    finally:
        if before is not None:
            os.umask(before)
