"""Unix sockets: who listens at one, whether a client may trust it, and how to take one over.

In /tmp anybody can make the folder in which fishd's socket would be, and answer there.
"""

import errno
import os
import socket
import stat
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from fishd.core.errors import StartupError
from fishd.core.process.lockfile import NotALock, Taken, lock_path, locked

LONGEST_PATH = 107
"""Of the path of a Unix socket, by Linux [bytes]."""
LEAVING, AGAIN = 1.0, 0.02
"""How long the gateways of a fishd that was killed may take to leave, and a pause meanwhile [s]."""
GROUP_MASK = 0o117
"""The umask of a socket to which user and group of this process may connect, and no other user."""
_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_ROOT = 0


def check_length(path: str) -> None:
    """Raises ValueError where the path is too long for a Unix socket."""
    length = len(os.fsencode(path))
    if length > LONGEST_PATH:
        raise ValueError(
            f"the path of a Unix socket has at most {LONGEST_PATH} bytes, this one has {length}; "
            "choose a shorter one, such as in /run or /tmp"
        )


def stranger(path: Path) -> str:
    """Why this user must not trust who serves the socket at `path`; empty where nothing is wrong.

    Trusted are this user, root, and the owner of a folder that only root can have made for him, as
    /run/fishd is for the service. Nobody else may write to the folder, nor be the one who listens.
    Where there is no socket, there is no stranger.
    """
    folder = path.parent
    try:
        found, above = folder.lstat(), folder.parent.stat()
    except OSError:
        return ""
    if stat.S_ISLNK(found.st_mode) and not _is_roots_alone(above):
        return f"{folder} is a symbolic link"
    found = folder.stat() if stat.S_ISLNK(found.st_mode) else found
    trusted = {os.geteuid(), _ROOT}
    if _is_roots_alone(above):
        trusted.add(found.st_uid)
    if found.st_uid not in trusted:
        return f"{folder} belongs to user {found.st_uid}"
    if found.st_mode & _OTHERS:
        return f"others may write to {folder}"
    with suppress(PermissionError):
        found_there = listener(path)
        if found_there and found_there.user not in trusted:
            return f"it is user {found_there.user} who listens there"
    return ""


def _is_roots_alone(folder: os.stat_result) -> bool:
    return folder.st_uid == _ROOT and not folder.st_mode & _OTHERS


class Listener(NamedTuple):
    """Who listens at a socket."""

    pid: int
    user: int


def listener(path: Path) -> Listener | None:
    """Who listens at a socket; None where nobody does, or none can be asked now.

    Raises PermissionError where this user may not connect.
    """
    with socket.socket(socket.AF_UNIX) as probe:
        failure = _connect(probe, path)
        if failure == errno.EACCES:
            raise PermissionError(failure, os.strerror(failure), os.fspath(path))
        if failure:
            return None
        peer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, user, _ = struct.unpack("3i", peer)
    return Listener(pid, user)


def is_deserted(path: Path) -> bool:
    """True when it is certain, without a wait, that nobody listens at a socket."""
    with socket.socket(socket.AF_UNIX) as probe:
        failure = _connect(probe, path)
    return failure in (errno.ENOENT, errno.ENOTDIR, errno.ECONNREFUSED)


def _connect(probe: socket.socket, path: Path) -> int:
    """Connect without a wait; 0, or the errno of why that failed."""
    probe.setblocking(False)
    try:
        return probe.connect_ex(os.fspath(path))
    except OSError:  # no socket has a path that long
        return errno.ENOENT


@contextmanager
def claimed(path: Path, name: str, rival: str, advice: str) -> Iterator[None]:
    """Make sure that nobody else serves this socket, and remove its files at the end.

    name: what messages call the socket
    Binding alone does not tell: ZeroMQ takes the socket file of a living process away from it, and
    leaves its own behind. Raises `StartupError`, which names the `rival` and gives the `advice`,
    when somebody is there, this process included.
    """
    with ExitStack() as stack:
        try:
            if path.exists() and not path.is_socket():
                raise StartupError(
                    f"{path} is there already and is no socket; choose another address"
                )
            stack.enter_context(locked(path.resolve(), remove=True))
        except Taken as taken:
            raise StartupError(
                f"{rival} (pid {taken.pid}) already serves {name}; {advice}"
            ) from None
        except NotALock as error:
            raise StartupError(
                f"{error.filename} {error.strerror}; remove it, or choose an address in a folder "
                "of your own"
            ) from None
        except OSError as error:
            raise StartupError(
                f"{lock_path(path)}: cannot be made: {error.strerror}; "
                "choose an address in a folder that exists and that you may write to"
            ) from None
        given_up = time.monotonic() + LEAVING
        while path.is_socket() and not is_deserted(path):
            if time.monotonic() > given_up:  # a program that locks nothing
                raise StartupError(f"another program already serves {name}; {advice}")
            time.sleep(AGAIN)
        stack.callback(path.unlink, missing_ok=True)
        yield


def bind(server: socket.socket, path: Path, mask: int | None = None) -> None:
    """Bind a socket at a path that is `claimed`, in place of what a killed process left there.

    mask: umask for it, which says who may connect; None for that of this process
    Raises OSError.
    """
    path.unlink(missing_ok=True)
    before = os.umask(mask) if mask is not None else None
    try:
        server.bind(os.fspath(path))
    finally:
        if before is not None:
            os.umask(before)
