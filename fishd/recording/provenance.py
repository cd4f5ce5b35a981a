"""The origin of a recording: its metadata `fishd.run`."""

import getpass
import platform
import socket
import subprocess
from collections.abc import Mapping
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Literal

from fishd import __version__

FORMAT = 3
"""Version of the layout of a recording."""
Source = Literal["fishd", "simulation", "import"]
"""Origin of the ticks: a running fishd, whatever its robot, a run in virtual time, or a table."""


def provenance(
    run: str, source: Source, operator: str, subject: str, note: str, extra: Mapping[str, str]
) -> dict[str, str]:
    """Return the metadata `fishd.run` of a recording that begins now."""
    return {
        **extra,
        "run": run,
        "format": str(FORMAT),
        "source": source,
        "started": datetime.now().astimezone().isoformat(timespec="milliseconds"),
        "operator": operator or _user(),
        "subject": subject,
        "note": note,
        "version": __version__,
        "git_commit": git_commit(),
        "host": socket.gethostname(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


@cache
def git_commit() -> str:
    """Return the commit of fishd's sources, with `-dirty` for changed ones; empty without git."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return ""
    command = ("git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--dirty")
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=5)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip()


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        return ""
