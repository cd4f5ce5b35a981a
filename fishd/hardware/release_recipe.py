"""A small file with which another process releases the servo without the configuration.

fishd writes it when it opens a servo and at each calibration, for its configuration file and for
its control socket: `fishd-release` finds it by the first, `fishctl estop` by the second. Needs only
the standard library, and not pathlib, which takes longer to load than everything else here.
"""

import json
import os
import stat
from binascii import crc32
from contextlib import suppress
from typing import Any

from fishd.core.errors import ServoError, StartupError
from fishd.core.process.runtime_folder import runtime_folder

NOT_RELEASED = "the servo was not released and may still have pulses: cut its power"
"""Message of a failed release."""

_LARGEST = 65_536
_SHORTEST, _LONGEST = 500, 2500


def carry_out(function: str, neutral: float, arguments: dict[str, Any]) -> bool:
    """End the pulses as a driver's `LastResort` says; return True if there were any.

    neutral: pulse of neutral [µs]
    Raises `ServoError` with one line, also for other exceptions of the function but ImportError.
    """
    module, _, name = function.partition(":")
    try:
        found = getattr(__import__(module, fromlist=[name]), name)
        return bool(found(neutral, **arguments))
    except (ServoError, StartupError, ImportError):
        raise
    except Exception as error:
        raise ServoError(f"{function}: {type(error).__name__}: {error}") from error


def outcome(done: bool) -> str:
    """Return what a release has seen and done, in words."""
    return "pulses were on: neutral, then off" if done else "there were no pulses"


def write(config: str, function: str, neutral: float, arguments: dict[str, Any]) -> None:
    """Leave the recipe for the fishd that runs with a configuration file, or a socket; atomic.

    The rest is for `carry_out`; without a function, the robot has no servo. If it cannot be
    written, `fishd-release` does without it, and takes its time.
    """
    recipe = {"function": function, "neutral": neutral, "arguments": arguments}
    path = _path(config)
    temporary = f"{path}.{os.getpid()}"
    with suppress(OSError):
        text = json.dumps(recipe | {"config": os.path.realpath(config), "file": _signature(config)})
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


def write_without_servo(control: str) -> None:
    """Leave a recipe that says that the fishd at a control socket has no servo."""
    write(control, "", 1500.0, {})


def remove(config: str) -> None:
    """Remove the recipe: there is nothing to release, or nothing that is done quickly."""
    with suppress(OSError):
        os.unlink(_path(config))


def read(config: str) -> dict[str, Any] | None:
    """Return the recipe of the latest fishd with a configuration file, or a socket, if it left one.

    Its key `fresh` says whether the file has not changed since. A recipe that another user may
    have written, or that is not complete, is ignored.
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
            found["config"] == os.path.realpath(config)
            and isinstance(found["function"], str)
            and isinstance(found["arguments"], dict)
            and _SHORTEST <= found["neutral"] <= _LONGEST
        )
        return found | {"fresh": found["file"] == _signature(config)} if good else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _path(config: str) -> str:
    return f"{runtime_folder()}/release-{crc32(os.fsencode(os.path.realpath(config))):08x}.json"


def _signature(config: str) -> list[int]:
    """Changes with the file."""
    try:
        found = os.stat(config)
    except OSError:
        return []
    return [found.st_mtime_ns, found.st_size, found.st_ino]


def _ours(found: os.stat_result, kind: Any) -> bool:
    """Return whether a file has the right kind and can only come from this user or root."""
    return kind(found.st_mode) and found.st_uid in (os.geteuid(), 0) and not found.st_mode & 0o022
