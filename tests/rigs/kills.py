"""Kills of a process between two of its system calls."""

import os
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from typing import Any

WRITING = ("open", "write", "fdatasync", "fsync", "link", "unlink", "rename", "replace", "rmdir")


def ends_before(call: int, act: Callable[[], object]) -> bool:
    """Act in a process that is killed at this system call of `WRITING`; return if it had ended."""
    if not (child := os.fork()):
        calls = count()

        def dying(function: Callable[..., Any]) -> Callable[..., Any]:
            def calling(*args: Any, **options: Any) -> Any:
                if next(calls) == call:
                    os._exit(9)
                return function(*args, **options)

            return calling

        for name in WRITING:
            setattr(os, name, dying(getattr(os, name)))
        with suppress(BaseException):
            act()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
