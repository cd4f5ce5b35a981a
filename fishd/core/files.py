"""Reading of files that a user names, unused names of files, and atomic writing of files.

A read never blocks, whether the name belongs to a pipe, a device or a file without an end.
"""

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fishd.core.errors import FishdError

MAX_SETTINGS_BYTES = 64 * 2**10
"""Maximum size of a hand-written file [bytes]."""
MAX_TABLE_BYTES = 16 * 2**20
"""Maximum size of a table of numbers [bytes]."""

_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class FileProblem(Exception):
    """A file cannot be read or written; the message continues a sentence after its name."""


class NoFile(FileProblem):
    """The file does not exist."""


@contextmanager
def os_errors(kind: type[FishdError], problem: str, remedy: str = "") -> Iterator[None]:
    """Raise an error of this kind in place of an OSError: the problem, the reason, the remedy."""
    try:
        yield
    except OSError as error:
        if isinstance(error, FishdError):
            raise
        reason = f"{error.strerror or error}{remedy and f'; {remedy}'}"
        raise kind(f"{problem}: {reason}") from None


def read(path: Path, longest: int, reader: str) -> bytes:
    """Return the content of a regular file; raise `FileProblem`.

    longest: maximum size [bytes]
    reader: purpose of the file for messages, such as `a policy`
    """
    try:
        _check_kind(path.stat())  # first: opening a device may already have an effect on it
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            _check_kind(status)
            # A file of /proc has no size until it is read.
            content = file.read(longest + 1) if status.st_size <= longest else None
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
    """Return the content of a text file with line ends `\\n`; raise `FileProblem`."""
    try:
        text = read(path, longest, reader).decode(encoding)
    except UnicodeDecodeError as error:
        raise FileProblem(f"not a text file in UTF-8 ({error.reason})") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _check_kind(status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise FileProblem(f"is {describe_kind(status)}; a regular file is needed")


def describe_kind(status: os.stat_result) -> str:
    """Return what a path belongs to, such as `a folder`."""
    return _KINDS.get(stat.S_IFMT(status.st_mode), "something else")


def expand_user(path: str | os.PathLike[str]) -> Path:
    """Return the path with `~` or `~user` replaced; unchanged without such a user or home."""
    try:
        return Path(path).expanduser()
    except (RuntimeError, ValueError):  # ValueError: a zero byte in the user's name
        return Path(path)


def shipped_folder(name: str) -> Path:
    """Return a folder that is shipped with fishd, `config` or `systemd`.

    It lies in the installed package, or in the checkout.
    """
    package = Path(__file__).parents[1]
    installed = package / "shipped" / name
    return installed if installed.is_dir() else package.parent / name


def write_atomically(path: Path, content: str | bytes, *, new: bool = False) -> None:
    """Write or replace a file; a full disk or a kill leaves the old file, never a part of the new.

    If several processes write at once, the file of the last one remains.

    new: fail if the file exists
    Raise OSError, with the name of the file.
    """
    part = _temporary_path(path)
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
        with suppress(OSError):  # must not hide an earlier error
            part.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Wait until the entries of a folder are safe against a power cut; raise OSError."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def check_writable(path: Path) -> None:
    """Raise `FileProblem` if a file cannot be written, before the long work that produces it."""
    part = _temporary_path(path)
    try:
        if os.path.lexists(path):
            _check_kind(path.stat())
        else:
            with suppress(FileNotFoundError):
                path.lstat()  # raises OSError if the name is too long
        part.open("xb").close()
    except FileNotFoundError:
        raise FileProblem("its folder does not exist; create it") from None
    except OSError as error:
        raise FileProblem(f"cannot be written: {error.strerror}") from None
    except ValueError:
        raise FileProblem("cannot be written: a name has no zero byte") from None
    finally:
        with suppress(OSError, ValueError):
            part.unlink(missing_ok=True)


def unused_path(folder: Path, name: str, *suffixes: str) -> Path:
    """Return `name`, else `name-2`, `name-3` and so on in a folder, with the first suffix.

    suffixes: with each of them, no file and no folder of that name exists
    """

    def is_taken(name: str) -> bool:
        return any(os.path.lexists(folder / f"{name}{suffix}") for suffix in suffixes)

    return folder / f"{unused_name(name, is_taken)}{suffixes[0]}"


def unused_name(name: str, is_taken: Callable[[str], bool], separator: str = "-") -> str:
    """Return `name`, else `name-2`, `name-3` and so on: the first one that is not taken."""
    unused, number = name, 1
    while is_taken(unused):
        number += 1
        unused = f"{name}{separator}{number}"
    return unused


def _temporary_path(path: Path) -> Path:
    """Return a unique temporary path in the same folder, of permitted length."""
    return path.parent / f".{path.name[:50]}.{os.urandom(6).hex()}.part"
