"""Finds the processes of the gateways of a fishd."""

import contextlib
from pathlib import Path

from rigs.processes import Daemon, wait_until


def children(pid: int) -> list[int]:
    try:
        listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [int(child) for child in listed.split()]


def fork_server(daemon: Daemon) -> int:
    """The process that forks the gateways."""
    (pid,) = children(daemon.process.pid)
    return pid


def gateways(daemon: Daemon) -> dict[str, int]:
    """The processes of the gateways, by what they are for."""
    found = {}
    for server in children(daemon.process.pid):
        for pid in children(server):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                name = Path(f"/proc/{pid}/comm").read_text().strip()
                if not gone(pid) and name != "fishd-gateways":  # one that is being forked
                    found[name.removeprefix("fishd-")] = pid
    return found


def both_gateways(daemon: Daemon) -> dict[str, int]:
    """Wait until both gateways run, and return their processes by name.

    fishd answers before the second one has its name.
    """
    wait_until(lambda: len(gateways(daemon)) == 2)
    return gateways(daemon)


def gone(pid: int) -> bool:
    """Has a process ended? One that nobody has waited for yet has."""
    try:
        return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
