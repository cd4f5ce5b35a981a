"""Pictures of runs for a page: regular files of limited size, which no link leads to."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from fishd.core.files import FileProblem, NoFile, describe_kind

MAX_PICTURE_BYTES = 20 * 2**20
_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC


def open_run_picture(runs: Path, run: str) -> BinaryIO:
    """Return the picture in the folder of a run, open; raise `FileProblem`.

    Raise `NoFile` if there is no such folder, or no picture in it.
    """
    place = open_entry(runs / run, f"'{run}'", os.O_DIRECTORY)
    try:
        with os.scandir(place) as entries:
            name = min((entry.name for entry in entries if entry.name.endswith(".png")), default="")
        if not name:
            raise NoFile(f"'{run}' has no picture")
        return open_picture(Path(name), f"'{run}/{name}'", place)
    finally:
        os.close(place)


def open_picture(path: Path, name: str, folder: int | None = None) -> BinaryIO:
    """Return a picture, open; raise `FileProblem`.

    name: for messages; folder: descriptor of the folder to which a relative path belongs
    """
    file = os.fdopen(open_entry(path, name, folder=folder), "rb")
    if os.fstat(file.fileno()).st_size <= MAX_PICTURE_BYTES:
        return file
    file.close()
    raise FileProblem(f"{name} is longer than {MAX_PICTURE_BYTES // 2**20} MB")


def open_entry(path: Path, name: str, kind: int = 0, folder: int | None = None) -> int:
    """Return a descriptor of a folder or a regular file; raise `FileProblem`."""
    is_wanted, wanted = (stat.S_ISDIR, "folder") if kind else (stat.S_ISREG, "regular file")
    try:
        descriptor = os.open(path, _FLAGS | kind, dir_fd=folder)
        status = os.fstat(descriptor)
        if is_wanted(status.st_mode):
            return descriptor
        os.close(descriptor)
    except FileNotFoundError:
        raise NoFile(f"{name}: no such {wanted}") from None
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENOTDIR, errno.ENXIO):  # ENXIO: a socket
            raise FileProblem(f"{name} cannot be read: {error.strerror}") from None
        status = os.stat(path, dir_fd=folder, follow_symlinks=False)
    raise FileProblem(f"{name} is {describe_kind(status)}; a {wanted} is needed")
