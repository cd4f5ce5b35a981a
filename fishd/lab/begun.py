"""The folder of an experiment that can be gone on with: whose it is, and with what it was begun."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from fishd.core import files
from fishd.core.errors import ConfigError
from fishd.core.files import FileProblem, write_atomically
from fishd.core.lockfile import NotALock, Taken, locked

OTHERS = ("control", "name", "panel", "realtime", "start", "state_folder", "telemetry")
"""Sections and keys of a configuration that have no part in the thrust."""


@contextmanager
def owned(path: Path, what: str) -> Iterator[None]:
    """While this lasts, no other experiment of this kind uses the folder; raises `ConfigError`.

    what: such as `sweep`
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made a folder: {error.strerror}") from None
    try:
        with locked(path / what, remove=True):
            yield
    except Taken as taken:
        raise ConfigError(f"{path}: a {what} runs in it, process {taken.pid}") from None
    except NotALock as error:
        raise ConfigError(f"{error.filename}: {error.strerror}") from None


def begin(file: Path, begun: Struct, what: str) -> None:
    """Write down with what an experiment begins, or compare it with what is written there.

    begun: a configuration in its field `config`
    what: such as `sweep`
    Raises `ConfigError` where another one began in the folder, and OSError.
    """
    if file.exists():
        _check_same(file, begun, what)
        return
    if any(not each.name.endswith(".lock") for each in file.parent.iterdir()):
        raise ConfigError(
            f"{file.parent}: not empty, and no {what} began in it; give another --folder"
        )
    write_atomically(file, msgspec.json.format(msgspec.json.encode(begun), indent=2))


def _check_same(file: Path, begun: Struct, what: str) -> None:
    try:
        data = msgspec.json.decode(files.read(file, files.SETTINGS, f"a {what}"), type=type(begun))
    except FileProblem as problem:
        raise ConfigError(f"{file}: {problem}") from None
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{file}: no {what} began so: {error}") from None
    before, now = (_leaves(msgspec.to_builtins(each)) for each in (data, begun))
    for key in dict.fromkeys([*before, *now]):
        if key == "version" or key.removeprefix("config.").partition(".")[0] in OTHERS:
            continue
        if before.get(key) != now.get(key):
            raise ConfigError(
                f"{file}: this {what} was begun with {key} = {before.get(key)}, now it is "
                f"{now.get(key)}; give the same, or another --folder"
            )


def _leaves(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            found |= _leaves(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found
