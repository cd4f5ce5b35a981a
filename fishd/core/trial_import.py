"""Trial of an import of another package in a child process, which such code may crash or end."""

import os
import signal
import subprocess
from functools import lru_cache

from fishd.core.process.safe_path import python_command

TIMEOUT_S = 8.0
"""Longest time that an import may take [s]."""
_CLOSED = 99
"""Exit status of the child whose pipe was closed."""
_CHILD = f"""
import os, sys
try:
    __import__(sys.argv[2])
except BaseException:
    pass  # the parent gets the same error, and reports it
try:
    os.write(int(sys.argv[1]), b"1")
except OSError:
    os._exit({_CLOSED})
os._exit(0)
"""


@lru_cache
def find_danger(module: str) -> str:
    """Return what the import of a module does to its process; empty if it survives.

    An import that raises an exception is no danger.
    """
    reader, writer = os.pipe()
    command = python_command("-c", _CHILD, str(writer), module)
    quiet = subprocess.DEVNULL
    try:
        status = subprocess.run(
            command,
            pass_fds=(writer,),
            timeout=TIMEOUT_S,
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
            check=False,
        ).returncode
    except subprocess.TimeoutExpired:
        return f"its import does not end within {TIMEOUT_S:g} s"
    finally:
        os.close(writer)
        os.set_blocking(reader, False)
        try:
            survived = bool(os.read(reader, 1))
        except BlockingIOError:  # a process that the package has started holds the pipe
            survived = False
        os.close(reader)
    if survived:
        return ""
    if status == _CLOSED:
        return "its import closes files of its process"
    if status < 0:
        return f"its import ends its process with {signal.Signals(-status).name}"
    return f"its import ends its process with exit status {status}"
