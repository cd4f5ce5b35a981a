"""What `fishd-release` needs to let go of the servo without the configuration: a small file.

fishd writes it when it opens a servo and at each calibration. Needs nothing but the standard
library, and of that not pathlib, which takes longer to load than all of this.
"""

import json
import os
import stat
from binascii import crc32
from contextlib import suppress
from typing import Any

from fishd.runtime_folder import runtime_folder

NOT_RELEASED = "the servo was not released and may still have pulses: cut its power"
"""What to say where a release has failed."""

_LARGEST = 65_536
_NUMBERS = (("gpio", 0, 27), ("neutral", 500, 2500), ("frequency", 40, 333), ("port", 1, 65_535))
_TEXTS = ("driver", "host", "root", "config")


def write(config: str, servo: dict[str, Any]) -> None:
    """Leave the recipe for the fishd that runs with a configuration file; atomic.

    servo: driver, gpio, neutral [µs], frequency [Hz], host, port, root, chip, channel
    Where it cannot be written there is none, and `fishd-release` takes its time.
    """
    path = _path(config)
    temporary = f"{path}.{os.getpid()}"
    with suppress(OSError):
        text = json.dumps(servo | {"config": _absolute(config), "file": _signature(config)})
        os.makedirs(os.path.dirname(path), mode=0o700, exist_ok=True)
        if not _ours(os.lstat(os.path.dirname(path)), stat.S_ISDIR):
            return
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        file = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        try:
            os.write(file, text.encode())
        finally:
            os.close(file)
        os.replace(temporary, path)


def remove(config: str) -> None:
    """There is nothing to release for this configuration file, or nothing that is done quickly."""
    with suppress(OSError):
        os.unlink(_path(config))


def read(config: str) -> dict[str, Any] | None:
    """The recipe of the latest fishd that ran with a configuration file; None where there is none.

    Its key `fresh` says whether the file has not changed since. One that somebody else may have
    written, or that is not whole, is none.
    """
    try:
        file = os.open(_path(config), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            if not _ours(os.fstat(file), stat.S_ISREG):
                return None
            found = json.loads(os.read(file, _LARGEST))
        finally:
            os.close(file)
        good = (
            found["config"] == _absolute(config)
            and all(isinstance(found[key], str) for key in _TEXTS)
            and all(low <= found[key] <= high for key, low, high in _NUMBERS)
        )
        return found | {"fresh": found["file"] == _signature(config)} if good else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _path(config: str) -> str:
    return f"{runtime_folder()}/release-{crc32(os.fsencode(_absolute(config))):08x}.json"


def _absolute(config: str) -> str:
    return os.path.realpath(config)


def _signature(config: str) -> list[int]:
    """Changes with the file."""
    try:
        found = os.stat(config)
    except OSError:
        return []
    return [found.st_mtime_ns, found.st_size, found.st_ino]


def _ours(found: os.stat_result, kind: Any) -> bool:
    """Of the right kind, and nobody but this user or root can have put it there."""
    return kind(found.st_mode) and found.st_uid in (os.geteuid(), 0) and not found.st_mode & 0o022
