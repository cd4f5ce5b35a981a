"""Command of a fishctl that ends with the process that starts it."""

import os
from collections.abc import Iterable

from fishd.core.process.safe_path import python_command

_CHILD = """\
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, int(signal.SIGTERM), 0, 0, 0)  # PR_SET_PDEATHSIG
if os.getppid() != int(sys.argv.pop(1)):  # its parent was killed before
    sys.exit(1)
os.nice(5)
from fishd.__main__ import fishctl
fishctl()
"""


def fishctl_command(words: Iterable[str]) -> list[str]:
    """Return the command of a fishctl that ends with this process."""
    return python_command("-c", _CHILD, str(os.getpid()), *words)
