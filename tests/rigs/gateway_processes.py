"""Processes of the gateways of a fishd."""

from pathlib import Path

from rigs.processes import Daemon, wait_until


def gateways(daemon: Daemon) -> list[int]:
    """Return the processes of the gateways that live; that of this machine's clients comes first.

    A process that fishd has just started does not have its name yet, and is left out.
    """
    pid = daemon.process.pid
    try:
        listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [int(child) for child in listed if _name(int(child)) == "fishd-gateway"]


def gateway(daemon: Daemon, former: int = 0) -> int:
    """Wait until there is a gateway other than a former one, and return its process."""
    wait_until(lambda: bool(set(gateways(daemon)) - {former}))
    return next(pid for pid in gateways(daemon) if pid != former)


def gone(pid: int) -> bool:
    """Return whether a process has ended; a zombie has."""
    try:
        return "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def _name(pid: int) -> str:
    try:
        return "" if gone(pid) else Path(f"/proc/{pid}/comm").read_text().strip()
    except (FileNotFoundError, ProcessLookupError):
        return ""
