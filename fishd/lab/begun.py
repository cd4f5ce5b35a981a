"""The folder of an experiment that can be resumed: whose it is, and with what it was begun."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from fishd import __version__
from fishd.core import files
from fishd.core.errors import ConfigError, FishdError
from fishd.core.files import FileProblem, write_atomically
from fishd.core.process.lockfile import NotALock, Taken, locked

OTHERS = ("control", "name", "panel", "realtime", "start", "state_folder", "telemetry")
"""Sections and keys of a configuration that have no part in the thrust."""


@contextmanager
def owned(path: Path, what: str) -> Iterator[None]:
    """While this lasts, no other experiment of this kind uses the folder.

    Raises `ConfigError` where another one does, `FishdError` where it cannot be made.

    what: such as `sweep`
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FishdError(f"{path}: cannot be made a folder: {error.strerror}") from None
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
        raise ConfigError(
            f"{file}: not as this fishd ({__version__}) writes it: {error}; give another --folder"
        ) from None
    before, now = (_relevant(each) for each in (data, begun))
    for key in dict.fromkeys([*before, *now]):
        known = (key in before and key in now) or not key.startswith("config.")
        if known and before.get(key) != now.get(key):
            raise ConfigError(
                f"{file}: this {what} was begun with {key} = {before.get(key)}, now it is "
                f"{now.get(key)}; give the same, or another --folder"
            )
    if others := [key for key in (*before, *now) if not (key in before and key in now)]:
        version = getattr(data, "version", __version__)
        who = f"fishd {version}" if version != __version__ else "another fishd"
        has = "has" if others[0] in before else "has no"
        raise ConfigError(
            f"{file}: this {what} was begun with {who}, whose configuration {has} {others[0]}, "
            "unlike that of now; give another --folder"
        )


def _relevant(begun: Struct) -> dict[str, Any]:
    """What thrust depends on, by dotted keys."""
    return {
        key: value
        for key, value in _leaves(msgspec.to_builtins(begun)).items()
        if key != "version" and key.removeprefix("config.").partition(".")[0] not in OTHERS
    }


def _leaves(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            found |= _leaves(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found
