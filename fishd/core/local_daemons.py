"""The fishds that run on this machine, found by their names in the kernel.

The file of a socket may be gone, or in a folder that another environment does not name: after a
logout, or for a program that cron starts. A name in the kernel is always there. fishd answers a few
requests at it, of its own user, of root, and of the members of its group.
"""

import os
from binascii import crc32
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from fishd.core import protocol
from fishd.core.errors import FishError
from fishd.core.process import kernel_names
from fishd.core.process.kernel_names import Holder
from fishd.core.signals import Status

SERVICE_USER = "fishd"
"""User of the system's service."""
ANSWER_TIMEOUT_S = 0.4
"""Longest time to wait for an answer [s]."""
_PREFIX = "daemon/"


class LocalDaemon(NamedTuple):
    """fishd that runs on this machine."""

    user: int
    pid: int
    hash: str
    """Hash of the address of its control socket when it started."""
    name: str

    def ask(self, request: bytes, timeout: float = ANSWER_TIMEOUT_S) -> bytes | None:
        """Send a request and return the reply; None without one from this process.

        timeout: longest time to wait [s]
        """
        answer = kernel_names.exchange_datagrams(self.name, request, timeout)
        return answer[0] if answer and answer[1] == (self.pid, self.user) else None

    def describe(self) -> str:
        """Return a phrase that names the process and its address."""
        where = self.control_address()
        place = f"serves {where}" if where else "does not answer, or has no control socket"
        return f"the fishd of process {Holder(self.pid, self.user)} {place}"

    def control_address(self) -> str:
        """Return the address of its control socket; empty if it has none or does not answer."""
        request = protocol.Request(v=protocol.VERSION, id=1, op="status", args={})
        try:
            reply = protocol.decode_reply(self.ask(protocol.encode(request)) or b"")
            return msgspec.json.decode(reply.result or b"", type=Status).control
        except (msgspec.DecodeError, FishError):
            return ""


def name_of_this(control: str) -> str:
    """Return the name of this process; control: address of its control socket."""
    unique = os.urandom(4).hex()  # containers may share names, but not pids
    return f"{_PREFIX}{os.geteuid()}/{os.getpid()}/{_hash(control)}/{unique}"


def find_all() -> list[LocalDaemon]:
    """Return the fishds of all users, as far as this user can see their processes."""
    return [daemon for daemon in _parse_names() if _is_process_of(daemon.pid, daemon.user)]


def find_own(control: str | None = None) -> list[LocalDaemon]:
    """Return the fishds that this user may ask: its own and that of the service.

    control: address of the control socket that they had when they started; None for any
    Root may ask all. Whether one is what its name says, only its answer shows.
    """
    trusted = {os.geteuid(), _service_user()}
    return [
        daemon
        for daemon in _parse_names()
        if (daemon.user in trusted or os.geteuid() == 0)
        and (control is None or daemon.hash == _hash(control))
    ]


def _parse_names() -> Iterator[LocalDaemon]:
    for name in kernel_names.read_names(_PREFIX):
        parts = name.removeprefix(_PREFIX).split("/")
        if len(parts) == 4 and parts[0].isdecimal() and parts[1].isdecimal():
            yield LocalDaemon(int(parts[0]), int(parts[1]), parts[2], name)


def _is_process_of(pid: int, user: int) -> bool:
    """Return whether a process is one of a user: any user can hold any name."""
    try:
        return Path(f"/proc/{pid}").stat().st_uid == user
    except OSError:
        return False


def _service_user() -> int:
    import pwd

    try:
        return pwd.getpwnam(SERVICE_USER).pw_uid
    except KeyError:
        return -1


def _hash(control: str) -> str:
    kind, _, path = control.partition("://")
    real = f"{kind}://{os.path.realpath(path)}" if kind == "ipc" else control
    return f"{crc32(os.fsencode(real)):08x}"
