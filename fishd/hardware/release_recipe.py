"""Small file with which another process releases the servo without reading the configuration.

fishd writes it when it opens a servo and at each calibration, once for its configuration file and
once for its control socket: `fishd-release` uses the first, `fishctl estop` the second. This module
needs only the standard library without pathlib, which takes longer to load than the rest.
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

_PREFIX = "release-"
_MAX_BYTES = 65_536
_MIN_NEUTRAL_US, _MAX_NEUTRAL_US = 500, 2500


def carry_out(function: str, neutral: float, arguments: dict[str, Any]) -> bool:
    """End the pulses with the function of a driver's `LastResort`; return True if there were any.

    neutral: pulse width of neutral [µs]
    Raises `ServoError` with one line, also for any other exception of the function except
    ImportError and `StartupError`, which pass through.
    """
    module, _, name = function.partition(":")
    try:
        end_pulses = getattr(__import__(module, fromlist=[name]), name)
        return bool(end_pulses(neutral, **arguments))
    except (ServoError, StartupError, ImportError):
        raise
    except Exception as error:
        raise ServoError(f"{function}: {type(error).__name__}: {error}") from error


def describe_outcome(done: bool) -> str:
    """Return a phrase that describes the result of a release."""
    return "pulses were on: neutral, then off" if done else "there were no pulses"


def write(config: str, function: str, neutral: float, arguments: dict[str, Any]) -> None:
    """Write the recipe of a fishd atomically.

    config: its configuration file or its control socket
    function, neutral, arguments: for `carry_out`; an empty function means a robot without a servo
    An error is ignored: without the recipe `fishd-release` only takes longer.
    """
    recipe = {"function": function, "neutral": neutral, "arguments": arguments}
    path = _path(config)
    temporary = f"{path}.{os.getpid()}"
    with suppress(OSError):
        text = json.dumps(recipe | {"config": os.path.realpath(config), "file": _signature(config)})
        os.makedirs(os.path.dirname(path), mode=0o700, exist_ok=True)
        if not _is_trusted(os.lstat(os.path.dirname(path)), stat.S_ISDIR):
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
    """Write a recipe that says that the fishd at a control socket has no servo."""
    write(control, "", 1500.0, {})


def remove(config: str) -> None:
    """Remove the recipe, because there is nothing to release or no quick way to do it."""
    with suppress(OSError):
        os.unlink(_path(config))


def read(config: str) -> dict[str, Any] | None:
    """Return the recipe that the latest fishd left for a configuration file or socket, or None.

    Its key `fresh` is True if that file has not changed since. A recipe that another user may have
    written, or that is incomplete, is ignored.
    """
    recipe = _read(_path(config))
    if recipe is None or recipe["config"] != os.path.realpath(config):
        return None
    return recipe | {"fresh": recipe["file"] == _signature(config)}


def read_all(folder: str) -> list[dict[str, Any]]:
    """Return the recipes in a folder that can only come from this user or root."""
    try:
        names = os.listdir(folder)
    except OSError:
        return []
    recipes = (_read(f"{folder}/{name}") for name in names if name.startswith(_PREFIX))
    return [recipe for recipe in recipes if recipe]


def _read(path: str) -> dict[str, Any] | None:
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            if not _is_trusted(os.fstat(file), stat.S_ISREG):
                return None
            recipe: dict[str, Any] = json.loads(os.read(file, _MAX_BYTES))
        finally:
            os.close(file)
        valid = (
            isinstance(recipe["config"], str)
            and isinstance(recipe["file"], list)
            and isinstance(recipe["function"], str)
            and isinstance(recipe["arguments"], dict)
            and _MIN_NEUTRAL_US <= recipe["neutral"] <= _MAX_NEUTRAL_US
        )
        return recipe if valid else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _path(config: str) -> str:
    return f"{runtime_folder()}/{_PREFIX}{crc32(os.fsencode(os.path.realpath(config))):08x}.json"


def _signature(config: str) -> list[int]:
    """Return numbers that change when the file changes; none without a file."""
    try:
        status = os.stat(config)
    except OSError:
        return []
    return [status.st_mtime_ns, status.st_size, status.st_ino]


def _is_trusted(status: os.stat_result, has_kind: Any) -> bool:
    """Return whether a file has the right kind and can only come from this user or root."""
    return (
        has_kind(status.st_mode)
        and status.st_uid in (os.geteuid(), 0)
        and not status.st_mode & 0o022
    )
