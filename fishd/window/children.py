"""fishctl as a child process, which ends with this process."""

import asyncio
import os
import shlex
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from fishd.core import text
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError
from fishd.core.experiments import PROGRESS_VARIABLE
from fishd.core.process.fishctl_child import fishctl_command

T = TypeVar("T")
_decode: Callable[[bytes], Any] = decoder(Any)


class JobError(FishdError):
    """A job cannot be started, or there is none."""


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
        if process.returncode is None:  # the request has ended before
            with suppress(ProcessLookupError):
                process.kill()
    if process.returncode and not output:
        message = text.line(errors.decode("utf-8", "replace")).removeprefix("fishctl: ")
        raise JobError(message or f"{shlex.join(words)} failed")
    return output


async def call_json(words: list[str], runs: Path, decode: Callable[[bytes], T] = _decode) -> T:
    """Return the JSON that fishctl prints, None if it prints nothing; raise `JobError`."""
    try:
        return decode(await call(words, runs) or b"null")
    except msgspec.DecodeError as error:  # such as a part, if it was killed
        raise JobError(f"'fishctl {words[0]}' answered: {text.error_message(error)}") from None
