"""Keys of fishd and of its clients, in a folder with three files.

`key` is secret; `key.pub` is the public key that belongs to it; `known` has a line for each public
key of others: at fishd `drive KEY NAME` or `watch KEY NAME`, at a client `tcp://HOST:PORT KEY`.
"""

import os
import re
from pathlib import Path
from typing import NamedTuple

from fishd.core import files
from fishd.core.addresses import KEYS_VARIABLE
from fishd.core.errors import ConfigError, NoKey
from fishd.core.trusted_folder import find_folder_problem

SECRET_FILE, PUBLIC_FILE, KNOWN_FILE = "key", "key.pub", "known"
ROLES = ("watch", "drive")
"""Roles of clients: `watch` receives telemetry, reads and may request an emergency stop; `drive`
may do everything."""

_MAX_BYTES = 2**16
_KEY = re.compile(r"[0-9A-Za-z.:+=^!/*?&<>()\[\]{}@%$#-]{40}")


class KnownKey(NamedTuple):
    """A line of the file `known`."""

    what: str
    """Role of a client, or address of a fishd."""
    key: str
    name: str


class Access(NamedTuple):
    """Keys with which a client connects to one fishd."""

    folder: Path
    secret: str
    server: str
    """Public key of fishd."""


def client_folder() -> Path:
    """Return the folder with the keys of a client: $FISHD_KEYS, else one of this user."""
    if given := os.environ.get(KEYS_VARIABLE):
        return files.expand_user(given)
    return files.expand_user(os.environ.get("XDG_CONFIG_HOME") or "~/.config") / "fishd" / "keys"


def find_access(endpoint: str) -> Access | None:
    """Return the keys for an endpoint; None if the client has no line for it in `known`.

    Raise `NoKey` if there is a line, but no usable key.
    """
    folder = client_folder()
    if KEYS_VARIABLE not in os.environ and not os.path.lexists(folder / KNOWN_FILE):
        return None
    try:
        lines, mistakes = read_known(folder)
        for line in lines:
            if line.what == endpoint:
                return Access(folder, read_secret(folder), line.key)
    except ConfigError as error:
        raise NoKey(str(error)) from None
    if mistakes:
        raise NoKey(mistakes[0])
    return None


def read_secret(folder: Path) -> str:
    """Return the secret key in a folder; raise `ConfigError` if it is missing, open or damaged."""
    path = folder / SECRET_FILE
    text = _read(path, 0o077, "read").strip()
    if not _KEY.fullmatch(text):
        raise ConfigError(f"{path}: it does not hold a key of 40 characters; {_make_key(folder)}")
    return text


def read_known(folder: Path) -> tuple[list[KnownKey], list[str]]:
    """Return the lines of `known`, and a message for each malformed one; raise `ConfigError`."""
    path = folder / KNOWN_FILE
    known, mistakes = [], []
    for number, line in enumerate(_read(path, 0o022, "change").splitlines(), 1):
        words = line.split(maxsplit=2)
        if not words or words[0].startswith("#"):
            continue
        what, key, name = (*words, "", "")[:3]
        is_address = what.startswith("tcp://")
        if (what in ROLES or is_address) and _KEY.fullmatch(key):
            known.append(KnownKey(what, key, name))
        else:
            mistakes.append(
                f"{path}, line {number}: 'drive KEY NAME', 'watch KEY NAME' or "
                "'tcp://HOST:PORT KEY' is needed, with a KEY of 40 characters"
            )
    return known, mistakes


def make_keys(folder: Path, public: str, secret: str) -> None:
    """Write a new pair of keys into a folder, which is created; raise `ConfigError`.

    A key that is there already is never overwritten.
    """
    notes = "# A line for each key, as 'fishctl keygen' prints it.\n"
    try:
        for parent in reversed(folder.parents):  # pathlib would leave their modes to the umask
            parent.mkdir(mode=0o755, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        _check_folder(folder)
        for name, content, mode in (
            (SECRET_FILE, f"{secret}\n", 0o600),
            (PUBLIC_FILE, f"{public}\n", 0o644),
            (KNOWN_FILE, notes, 0o600),
        ):
            descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            with os.fdopen(descriptor, "w") as file:
                file.write(content)
    except FileExistsError as error:
        raise ConfigError(f"{error.filename}: it exists, and is not overwritten") from None
    except OSError as error:
        raise ConfigError(f"{error.filename or folder}: {error.strerror}") from None


def _read(path: Path, forbidden: int, may: str) -> str:
    """Return the text of a file; raise `ConfigError`, also if other users `may` use it."""
    try:
        text = files.read_text(path, _MAX_BYTES, "keys")
        status = path.stat()
    except files.NoFile:
        raise ConfigError(f"{path}: there is no such file; {_make_key(path.parent)}") from None
    except (files.FileProblem, OSError) as error:
        raise ConfigError(f"{path}: {error}") from None
    if status.st_mode & forbidden:
        raise ConfigError(
            f"{path}: other users may {may} it (mode {status.st_mode & 0o777:o}); run "
            f"'chmod {0o666 & ~forbidden:o} {path}'"
        )
    if status.st_uid not in (os.getuid(), 0):
        raise ConfigError(f"{path}: it belongs to another user; it must belong to this one or root")
    _check_folder(path.parent)
    return text


def _check_folder(folder: Path) -> None:
    """Raise `ConfigError` if other users may put keys into a folder."""
    if problem := find_folder_problem(folder):
        raise ConfigError(problem)


def _make_key(folder: Path) -> str:
    return f"'fishctl keygen --to {folder}' makes a key in a folder without one"
