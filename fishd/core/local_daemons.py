"""The fishds that run on this machine, found by their names in the kernel.

The file of a socket may be gone, or in a folder that another environment does not name: after a
logout, or for a program that cron starts. A name in the kernel is always there. fishd answers a few
requests at it, of its own user, of root, and of the members of its group.
"""

import os
from binascii import crc32
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from fishd.core import protocol, text
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
    socket: str
    """Number of the socket that has this name."""

    @property
    def is_certain(self) -> bool:
        """Whether it is certain that its process has this name: any user can hold any name."""
        return kernel_names.holds(self.pid, self.socket)

    @property
    def may_be_asked(self) -> bool:
        """Whether it answers this user: one of this user, or that of the service; root may ask all.

        The service answers only the members of its group.
        """
        return os.geteuid() in (0, self.user) or self.user == service_user()


def ask(
    daemons: Iterable[LocalDaemon], request: bytes, timeout: float = ANSWER_TIMEOUT_S
) -> dict[LocalDaemon, bytes]:
    """Send a request to each of these at once; return the replies.

    A reply of another process than the one that the name says is dropped: any user can hold any
    name.

    timeout: longest time to wait for all of them [s]
    """
    by_name = {daemon.name: daemon for daemon in daemons}
    answers = kernel_names.exchange_datagrams(by_name, request, timeout)
    return {
        daemon: answers[name][0]
        for name, daemon in by_name.items()
        if name in answers and answers[name][1] == (daemon.pid, daemon.user)
    }


def become(user: int) -> str:
    """Return the beginning of a command that ends pulses: only a fishd's user uses its recipe."""
    if user in (os.geteuid(), service_user()):
        return ""
    import pwd

    try:
        return f"sudo -u {pwd.getpwuid(user).pw_name} "
    except KeyError:
        return f"sudo -u \\#{user} "


def find_silent(daemons: Iterable[LocalDaemon]) -> list[LocalDaemon]:
    """Return those that certainly exist and do not answer."""
    daemons = list(daemons)
    replies = _ask_status(daemons)
    return [daemon for daemon in daemons if daemon not in replies and daemon.is_certain]


def _ask_status(daemons: Iterable[LocalDaemon]) -> dict[LocalDaemon, bytes]:
    request = protocol.Request(v=protocol.VERSION, id=1, op="status", args={})
    return ask(daemons, protocol.encode(request))


def describe(daemons: Iterable[LocalDaemon], option: str = "") -> str:
    """Return a phrase that names processes and where they can be reached.

    option: option with which `fishctl estop` means these
    """
    daemons = list(daemons)
    replies, phrases = _ask_status(d for d in daemons if d.may_be_asked), []
    for daemon in daemons:
        status = _read_status(replies.get(daemon, b""))
        name = format_name(daemon, status)
        if not daemon.may_be_asked:
            phrases.append(f"{name} runs, which this user may not ask")
        elif status is None and not daemon.is_certain:
            phrases.append(f"{name} does not answer")
        elif status is None:
            sudo = become(daemon.user)
            phrases.append(
                f"{name} hangs or is stopped: '{sudo}fishctl estop{option}' ends its pulses"
            )
        elif status.control:
            phrases.append(f"{name} runs: name it with --endpoint {status.control}")
        else:
            phrases.append(f"{name} says: {text.line(status.limitations[-1])}")
    return "; ".join(phrases)


def format_name(daemon: LocalDaemon, status: Status | None) -> str:
    """Return a phrase that names a fishd; status: its answer, if it has given one."""
    process = Holder(daemon.pid, daemon.user)
    if status is None:
        return f"the fishd of process {process}"
    return text.line(f"fish {status.name} (process {process})")


def _read_status(reply: bytes) -> Status | None:
    """Return the status in a reply; None if there is none."""
    try:
        result = protocol.decode_reply(reply).result
        return msgspec.json.decode(result or b"", type=Status)
    except (msgspec.DecodeError, FishError):
        return None


def name_of_this(control: str) -> str:
    """Return the name of this process; control: address of its control socket."""
    unique = os.urandom(4).hex()  # containers may share names, but not pids
    return f"{_PREFIX}{os.geteuid()}/{os.getpid()}/{hash_address(control)}/{unique}"


def find_all() -> list[LocalDaemon]:
    """Return the fishds of all users."""
    return list(_parse_names())


def find_own(control: str | None = None) -> list[LocalDaemon]:
    """Return the fishds that this user may ask: its own and that of the service.

    control: address of the control socket that they had when they started; None for any
    Root may ask all. Whether one is what its name says, only its answer shows.
    """
    own = (daemon for daemon in _parse_names() if daemon.may_be_asked)
    return [daemon for daemon in own if control is None or daemon.hash == hash_address(control)]


def _parse_names() -> Iterator[LocalDaemon]:
    for name, number in kernel_names.read_names(_PREFIX).items():
        parts = name.removeprefix(_PREFIX).split("/")
        if len(parts) == 4 and parts[0].isdecimal() and parts[1].isdecimal():
            daemon = LocalDaemon(int(parts[0]), int(parts[1]), parts[2], name, number)
            if not _is_of_another_user(daemon):
                yield daemon


def _is_of_another_user(daemon: LocalDaemon) -> bool:
    """Return whether its process certainly belongs to another user than its name says.

    This user may not see the processes of others, or those in another container.
    """
    try:
        return Path(f"/proc/{daemon.pid}").stat().st_uid != daemon.user
    except OSError:
        return False


@cache
def service_user() -> int:
    """Return the number of the user of the system's service; -1 if there is none."""
    import pwd

    try:
        return pwd.getpwnam(SERVICE_USER).pw_uid
    except KeyError:
        return -1


def hash_address(control: str) -> str:
    """Return the hash of the address of a control socket, the same for all links to it."""
    kind, _, path = control.partition("://")
    real = f"{kind}://{os.path.realpath(path)}" if kind == "ipc" else control
    return f"{crc32(os.fsencode(real)):08x}"
