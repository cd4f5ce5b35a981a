"""Protection of Python processes that fishd starts against code in the working directory.

In a folder that others can write to, such as /tmp, another user may have put a `joblib.py` or a
`libc.so.6`. `fishd.__main__` does the same for fishd itself.
"""

import os
import sys

_SAFE_PATH, _LIBRARIES = "PYTHONSAFEPATH", "LD_LIBRARY_PATH"


def python_command(*arguments: str) -> list[str]:
    """Return the command that runs this Python with arguments, such as `-m fishd`."""
    return [sys.executable, "-P", *arguments]


class SafeChildren:
    """Context in which started Python processes ignore the working directory.

    For libraries that start processes themselves; use `python_command` for all others.
    """

    def __enter__(self) -> None:
        self._before = {name: os.environ.get(name) for name in (_SAFE_PATH, _LIBRARIES)}
        os.environ[_SAFE_PATH] = "1"
        if folders := self._before[_LIBRARIES]:
            # An empty folder stands for the working directory; cv2 adds one when it is loaded.
            os.environ[_LIBRARIES] = ":".join(filter(None, folders.split(":")))

    def __exit__(self, *_: object) -> None:
        for name, value in self._before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
