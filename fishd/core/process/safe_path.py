"""Protection of Python processes that fishd starts against modules in the working directory.

In a folder that others can write to, such as /tmp, another user may have put a `joblib.py`.
`fishd.__main__` does the same for fishd itself.
"""

import os
import sys

_VARIABLE = "PYTHONSAFEPATH"


def python_command(*arguments: str) -> list[str]:
    """Return the command that runs this Python with arguments, such as `-m fishd`."""
    return [sys.executable, "-P", *arguments]


class SafeChildren:
    """Context in which started Python processes ignore the working directory.

    For libraries that start processes themselves; use `python_command` for all others.
    """

    def __enter__(self) -> None:
        self._before = os.environ.get(_VARIABLE)
        os.environ[_VARIABLE] = "1"

    def __exit__(self, *_: object) -> None:
        if self._before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = self._before
