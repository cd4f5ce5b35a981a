"""Processes of the gateways of a fishd."""

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
    """Return the process that forks the gateways."""
    (pid,) = children(daemon.process.pid)
    return pid


def gateways(daemon: Daemon) -> dict[str, int]:
    """Return the processes of the gateways by their purpose."""
    pids = {}
    for server in children(daemon.process.pid):
        pids |= gateways_of(server)
    return pids


def gateways_of(server: int) -> dict[str, int]:
    """Return the processes that a fork server has forked, by their purpose."""
    pids = {}
    for pid in children(server):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            name = Path(f"/proc/{pid}/comm").read_text().strip()
            if not gone(pid) and name != "fishd-gateways":  # a process that is being forked
                pids[name.removeprefix("fishd-")] = pid
    return pids


def both_gateways(daemon: Daemon) -> dict[str, int]:
    """Wait until both gateways run, and return their processes by name.

    fishd answers before the second one has its name.
    """
    wait_until(lambda: len(gateways(daemon)) == 2)
    return gateways(daemon)


def gone(pid: int) -> bool:
    """Return whether a process has ended; a zombie has."""
    try:
        return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
