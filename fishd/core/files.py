"""Reads the files that people name, and writes files atomically.

Whatever a name leads to, a pipe, a device or a file without an end, the answer comes at once.
"""

import os
import stat
from contextlib import suppress
from pathlib import Path

SETTINGS = 64 * 2**10
"""Longest file that people write by hand [bytes]."""
TABLE = 16 * 2**20
"""Longest table of numbers [bytes]."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class FileProblem(Exception):
    """Why a file cannot be read; the message goes after its name."""


class NoFile(FileProblem):
    """There is none."""


def read(path: Path, longest: int, reader: str) -> bytes:
    """The content of a regular file; raises `FileProblem`.

    longest: more is not read [bytes]
    reader: what the file is for, such as `a policy`; the message names it
    """
    try:
        _check_kind(path.stat())  # first: to open a device may already do something to it
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            found = os.fstat(descriptor)
            _check_kind(found)
            # A file of /proc has no size until it is read.
            content = file.read(longest + 1) if found.st_size <= longest else None
    except (FileNotFoundError, NotADirectoryError):
        raise NoFile("no such file") from None
    except OSError as error:
        raise FileProblem(f"cannot be read: {error.strerror}") from None
    except ValueError:
        raise NoFile("no such file: a name has no zero byte") from None
    if content is None or len(content) > longest:
        size = f"{longest / 2**20:g} MB" if longest >= 2**20 else f"{longest // 2**10} kB"
        raise FileProblem(f"is longer than {size}, far more than {reader} needs")
    return content


def read_text(path: Path, longest: int, reader: str, encoding: str = "utf-8") -> str:
    """The same as text; line ends are \\n. Raises `FileProblem`."""
    try:
        text = read(path, longest, reader).decode(encoding)
    except UnicodeDecodeError as error:
        raise FileProblem(f"not a text file in UTF-8 ({error.reason})") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _check_kind(found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
        raise FileProblem(f"is {kind}; a regular file is needed")


def expanded(path: str | os.PathLike[str]) -> Path:
    """The path with its `~` or `~user` replaced; as it is where there is no such user or home."""
    try:
        return Path(path).expanduser()
    except (RuntimeError, ValueError):  # the latter for a zero byte in the user's name
        return Path(path)


def write_atomically(path: Path, content: str | bytes, *, new: bool = False) -> None:
    """Write a file, or replace it; a full disk or a kill leaves the old one, never half a file.

    Of several writers at a time, the last one's is left, whole.

    new: there must be none of that name
    Raises OSError, with the name of the file.
    """
    part = _beside(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        with part.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if new:
            path.hardlink_to(part)  # unlike a rename, never onto another file
        else:
            part.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        with suppress(OSError):  # what went wrong before is to be told
            part.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Wait until a power cut no longer takes the names in it away again; raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_writable(path: Path) -> None:
    """Find out before long work whether a file can be written at its end.

    Raises `FileProblem`.
    """
    part = _beside(path)
    try:
        if os.path.lexists(path):
            _check_kind(path.stat())
        else:
            with suppress(FileNotFoundError):
                path.lstat()  # which complains about a name that is too long
        part.open("xb").close()
    except FileNotFoundError:
        raise FileProblem("there is no folder to put it into") from None
    except OSError as error:
        raise FileProblem(f"cannot be written: {error.strerror}") from None
    except ValueError:
        raise FileProblem("cannot be written: a name has no zero byte") from None
    finally:
        with suppress(OSError, ValueError):
            part.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    """A temporary name in the same folder, no other writer's, and of permitted length."""
    return path.parent / f".{path.name[:50]}.{os.urandom(6).hex()}.part"
