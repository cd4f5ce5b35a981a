"""Keeps files of the working directory from being imported, by fishd and by what it starts.

In a folder that others can write to, such as /tmp, another user may have put a `joblib.py`. This
module imports only what Python has loaded itself by the time that the first line of fishd runs.
"""

import os
import sys

_VARIABLE = "PYTHONSAFEPATH"


def python(*arguments: str) -> list[str]:
    """Return the command that runs this Python with arguments, such as `-m fishd`."""
    return [sys.executable, "-P", *arguments]


def leave_working_directory_out() -> None:
    """Import nothing from the working directory from now on, in this process or its children.

    `python -m fishd` puts that folder first; what Python itself loads before, such as `runpy`, only
    `python -P -m fishd` protects. A folder that PYTHONPATH names stays.
    """
    os.environ[_VARIABLE] = "1"
    if not sys.flags.safe_path and sys.path and sys.path[0] in ("", _working_directory()):
        del sys.path[0]


class SafeChildren:
    """A context in which Python processes are started that ignore the working directory.

    For libraries that start processes by themselves; `python` is for all others.
    """

    def __enter__(self) -> None:
        self._before = os.environ.get(_VARIABLE)
        os.environ[_VARIABLE] = "1"

    def __exit__(self, *_: object) -> None:
        if self._before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = self._before


def _working_directory() -> str:
    try:
        return os.getcwd()  # noqa: PTH109 (pathlib is not loaded yet)
    except OSError:  # it was deleted
        return ""
