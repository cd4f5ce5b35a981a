"""fishctl as a child process, which ends with this process."""

import asyncio
import os
import shlex
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from fishd.core import text
from fishd.core.errors import FishdError
from fishd.core.experiments import PROGRESS_VARIABLE
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


class JobError(FishdError):
    """A job cannot be started, or there is none."""


def fishctl_command(words: Iterable[str]) -> list[str]:
    """Return the command of a fishctl that ends with this process."""
    return python_command("-c", _CHILD, str(os.getpid()), *words)


async def spawn(words: list[str], runs: Path) -> asyncio.subprocess.Process:
    """Start fishctl; runs: folder of recordings and experiments."""
    return await asyncio.create_subprocess_exec(
        *fishctl_command(words),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={
            **os.environ,
            "FISHD_RUNS": str(runs),
            "PYTHONUNBUFFERED": "1",
            PROGRESS_VARIABLE: "json",
        },
        start_new_session=True,  # Ctrl-C in this terminal is for the window
    )


async def call(words: list[str], runs: Path) -> bytes:
    """Run fishctl like `spawn`, and return its output; raise `JobError`."""
    process = await spawn(words, runs)
    try:
        output, errors = await process.communicate()
    finally:
        if process.returncode is None:  # nobody waits for it any more
            with suppress(ProcessLookupError):
                process.kill()
    if process.returncode and not output:
        message = text.line(errors.decode("utf-8", "replace")).removeprefix("fishctl: ")
        raise JobError(message or f"{shlex.join(words)} failed")
    return output
