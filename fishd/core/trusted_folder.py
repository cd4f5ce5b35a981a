"""Search for other users that may change or replace a folder, such as one with keys."""

import os
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_MAX_LINKS = 40
"""Number of symbolic links on one way, as in the kernel."""


def find_folder_problem(folder: Path, *trusted: int) -> str | None:
    """Return why other users may change a folder, and what mends it; None if none may.

    Neither the folder nor one on the way to it may belong to another user than this one, root or
    the `trusted` ones, or be writable for others. On the way, a folder such as /tmp may be
    writable, where each user can only replace what is their own.
    """
    folder = folder.absolute()
    owners = {os.geteuid(), 0, *trusted}
    with suppress(OSError):  # what is missing or closed is named by those who read there
        for place, status in _list_way(folder):
            if status.st_uid not in owners:
                return (
                    f"{place} belongs to another user (id {status.st_uid}); it must belong to this "
                    f"one or root: run 'sudo chown -h {os.geteuid()} {place}'"
                )
            mode = status.st_mode
            is_shared = place != folder and mode & stat.S_ISVTX
            if mode & _WRITABLE_BY_OTHERS and not stat.S_ISLNK(mode) and not is_shared:
                what = "it" if place == folder else f"it, and so replace {folder}"
                return (
                    f"{place}: other users may change {what} (mode {stat.S_IMODE(mode):o}); run "
                    f"'chmod go-w {place}'"
                )
    return None


def _list_way(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield each folder and symbolic link that the kernel passes on its way to an absolute path."""
    place, names, links = Path("/"), list(reversed(path.parts[1:])), 0
    yield place, place.lstat()
    while names and links <= _MAX_LINKS:
        name = names.pop()
        place = place.parent if name == ".." else place / name
        status = place.lstat()
        yield place, status
        if stat.S_ISLNK(status.st_mode):
            target = place.readlink()
            links += 1
            names += reversed(target.parts[1:] if target.is_absolute() else target.parts)
            place = Path("/") if target.is_absolute() else place.parent
