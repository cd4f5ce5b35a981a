"""A temporary folder that is removed in any case, also if the window is killed."""

import os
import secrets
import shutil
import subprocess
import tempfile
from functools import cached_property
from pathlib import Path

from fishd.window.children import JobError

_REMOVER = """\
trap '' HUP INT TERM PIPE
mkdir -m 700 -- "$1" || exit
echo
read _
exec rm -rf -- "$1"
"""
"""Script that makes the folder, and removes it once no process holds the other end of its input."""


class Scratch:
    """A folder in /tmp for this process and its children, made when it is first used.

    A shell in the background removes it once this process and those children have ended that keep
    `descriptor` open. A child that outlives a killed parent can so leave nothing behind.
    """

    def __init__(self, prefix: str) -> None:
        """prefix: beginning of its name"""
        self._prefix = prefix

    def create(self) -> None:
        """Make the folder if there is none; raises `JobError` if it cannot be made.

        It may wait for a disk; `folder` and `descriptor` do not afterwards.
        """
        _ = self._content

    @property
    def folder(self) -> Path:
        """The folder; raises `JobError` if it cannot be made."""
        return self._content[0]

    @property
    def descriptor(self) -> int:
        """Descriptor that keeps the folder as long as a process has it open."""
        return self._content[1]

    @cached_property
    def _content(self) -> tuple[Path, int, "subprocess.Popen[bytes]"]:
        folder = Path(tempfile.gettempdir(), f"{self._prefix}{secrets.token_hex(8)}")
        read_end, write_end = os.pipe()
        with os.fdopen(read_end, "rb") as end:
            remover = subprocess.Popen(
                ["/bin/sh", "-c", _REMOVER, "sh", folder],
                stdin=end,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd="/",
                start_new_session=True,  # Ctrl-C in this terminal is for the window
            )
        assert remover.stdout
        with remover.stdout:
            if remover.stdout.readline():
                return folder, write_end, remover
        os.close(write_end)
        remover.wait()
        raise JobError(f"{folder} cannot be created")

    def close(self) -> None:
        """Remove the folder."""
        if "_content" in vars(self):
            folder, write_end, remover = self._content
            shutil.rmtree(folder, ignore_errors=True)
            remover.kill()
            remover.wait()
            os.close(write_end)
