"""Whose a Unix socket is: a client must not take orders, or comfort, from a stranger's.

In /tmp anybody can make the folder in which fishd's socket would be, and answer there.
"""

import os
import socket
import stat
import struct
from pathlib import Path

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
    listener = _listener(path)
    if listener is not None and listener not in trusted:
        return f"it is user {listener} who listens there"
    return ""


def _is_roots_alone(folder: os.stat_result) -> bool:
    return folder.st_uid == _ROOT and not folder.st_mode & _OTHERS


def _listener(path: Path) -> int | None:
    """The user who listens at a socket; None where nobody does, or none can be asked now."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        if probe.connect_ex(os.fspath(path)):
            return None
        peer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    _, user, _ = struct.unpack("3i", peer)
    return int(user)
