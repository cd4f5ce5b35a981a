"""Trial of an import of another package in a child process, which such code may crash or end."""

import os
import signal
import subprocess

from fishd.core.process.safe_path import python_command

TIMEOUT_S = 10.0
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


_verdicts: dict[str, str | None] = {}


def find_danger(module: str, timeout: float | None = None) -> str | None:
    """Return what the import of a module does to its process; None if it survives.

    An import that raises an exception is no danger. The result is kept, unless the import did not
    end in time: that may be the fault of a busy machine.

    timeout: longest time of the import; None for `TIMEOUT_S` [s]
    Raise `OSError` if the trial is not possible.
    """
    if module not in _verdicts:
        limit = TIMEOUT_S if timeout is None else timeout
        try:
            _verdicts[module] = _try(module, limit)
        except subprocess.TimeoutExpired:
            return f"its import does not end within {limit:g} s"
    return _verdicts[module]


def _try(module: str, timeout: float) -> str | None:
    reader, writer = os.pipe()
    command = python_command("-B", "-c", _CHILD, str(writer), module)
    quiet = subprocess.DEVNULL
    try:
        status = subprocess.run(
            command,
            pass_fds=(writer,),
            timeout=timeout,
            stdin=quiet,
            stdout=quiet,
            stderr=quiet,
            check=False,
        ).returncode
    finally:
        os.close(writer)
        os.set_blocking(reader, False)
        try:
            survived = bool(os.read(reader, 1))
        except BlockingIOError:  # a process that the package has started holds the pipe
            survived = False
        os.close(reader)
    if survived:
        return None
    if status == _CLOSED:
        return "its import closes files of its process"
    if status < 0:
        return f"its import ends its process with {_name(-status)}"
    return f"its import ends its process with exit status {status}"


def _name(number: int) -> str:
    """Return the name of a signal; most of the real-time signals have none in Python."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
