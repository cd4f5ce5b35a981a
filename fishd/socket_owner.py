"""Whose a Unix socket is: a client must not believe the replies of a stranger.

In /tmp anybody can make the folder in which fishd's socket would be, and answer there.
"""

import errno
import os
import socket
import stat
import struct
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_ROOT = 0


def stranger(path: Path) -> str:
    """Why nobody whom this user trusts serves the socket at `path`; empty where it is no stranger.

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
        probe.setblocking(False)
        try:
            failure = probe.connect_ex(os.fspath(path))
        except OSError:  # no socket has a path that long
            return None
        if failure == errno.EACCES:
            raise PermissionError(failure, os.strerror(failure), os.fspath(path))
        if failure:
            return None
        peer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, user, _ = struct.unpack("3i", peer)
    return Listener(pid, user)
