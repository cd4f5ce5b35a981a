"""Names in the kernel, each held by one process: abstract Unix sockets.

A name needs no file, so it does not depend on the environment of a process, and no user can
remove it. It ends with its process, however that ends, and processes of all users see it. Any user
can hold any name: a program that holds one of fishd's keeps fishd from starting, and the message
names its pid and user.
"""

import errno
import os
import select
import socket
import struct
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

_PREFIX = "fishd"
_MAX_NAME_BYTES = 107
"""Maximum length of an abstract name in Linux, without the zero byte before it [bytes]."""
_BACKLOG = 4096
"""Maximum number of processes that can read the holder of a name until it drops them."""
_TABLE = Path("/proc/net/unix")
"""The kernel's list of Unix sockets."""
_MAX_ANSWER_BYTES = 2**20
"""Maximum length of an answer [bytes]."""
_CREDENTIALS = "3i"
"""Layout of the kernel's struct ucred: pid, uid, gid."""
_NO_CONNECTION = {errno.ECONNREFUSED, errno.ENOENT}
_held: list[socket.socket] = []
"""Sockets of the names that this process holds."""


class Holder(NamedTuple):
    """Process that holds a name, and its user; 0 and -1 if the kernel does not say."""

    pid: int
    user: int

    def __str__(self) -> str:
        """Return the pid, and the user if it is another one than that of this process."""
        pid = str(self.pid) if self.pid else "unknown"
        return pid if self.user in (-1, os.geteuid()) else f"{pid} of user {self.user}"


class NameTaken(Exception):
    """A process, this one perhaps, holds the name."""

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} is held by a process")
        self._name = name

    @property
    def holder(self) -> Holder:
        """The process, found when this is read: the kernel queues only some such requests."""
        return find_holder(self._name) or Holder(0, -1)


@contextmanager
def claimed(name: str) -> Iterator[None]:
    """Hold a name within the context; raise `NameTaken` if a process, even this one, holds it."""
    with socket.socket(socket.AF_UNIX) as held:
        try:
            held.bind(_address(name))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise NameTaken(name) from None
        held.listen(_BACKLOG)
        held.setblocking(False)
        _held.append(held)
        try:
            yield
        finally:
            _held.remove(held)


def drop_readers(limit: int = 50) -> None:
    """Drop the connections of processes that have read the holder of a name; limit: of each."""
    for held in _held:
        with suppress(OSError):
            for _ in range(limit):
                held.accept()[0].close()


def find_holder(name: str) -> Holder | None:
    """Return the process that holds a name; None if none does."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        failure = probe.connect_ex(_address(name))
        if failure in _NO_CONNECTION:
            return None
        return read_listener(probe) if not failure else Holder(0, -1)  # too many have connected


def read_listener(probe: socket.socket) -> Holder:
    """Return the process that listens where a Unix socket is connected."""
    size = struct.calcsize(_CREDENTIALS)
    peer = probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    pid, user, _ = struct.unpack(_CREDENTIALS, peer)
    return Holder(pid, user)


def read_names(prefix: str) -> dict[str, str]:
    """Return the names that begin with a prefix and are held now by processes of any user.

    Each has the number of its socket, for `holds`. None where the kernel's list cannot be read, as
    with `ProcSubset=pid` of systemd.
    """
    start = f"@{_PREFIX}/{prefix}"
    try:
        table = _TABLE.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return {}
    rows = (line.split()[-2:] for line in table.splitlines())
    return {
        row[1].removeprefix(f"@{_PREFIX}/"): row[0] for row in rows if row[-1].startswith(start)
    }


def holds(pid: int, number: str) -> bool:
    """Return whether it is certain that a process of this user has the socket of this number."""
    with suppress(OSError):
        links = Path(f"/proc/{pid}/fd").iterdir()
        return any(str(link.readlink()) == f"socket:[{number}]" for link in links)
    return False


def bind_datagrams(name: str) -> socket.socket:
    """Return a socket that receives datagrams at a name, each with the sender's credentials."""
    server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        server.setblocking(False)
        server.bind(_address(name))
    except OSError:
        server.close()
        raise
    return server


def exchange_datagrams(
    names: Iterable[str], request: bytes, timeout: float
) -> dict[str, tuple[bytes, Holder]]:
    """Send a datagram to each name at once; return the answers and their senders, by name.

    timeout: longest time to wait for all of them [s]
    """
    waiting = {_address(name): name for name in names}
    answers: dict[str, tuple[bytes, Holder]] = {}
    with bind_datagrams("") as client:
        for address in list(waiting):
            try:
                client.sendto(request, address)
            except OSError:  # it has ended, or does not read
                del waiting[address]
        deadline = time.monotonic() + timeout
        while waiting and (remaining := deadline - time.monotonic()) > 0.0:
            if not select.select([client], [], [], remaining)[0]:
                break
            try:
                answer, holder, sender = receive_datagram(client, _MAX_ANSWER_BYTES)
            except OSError:
                continue
            if isinstance(sender, bytes) and sender in waiting:  # else another user's
                answers[waiting.pop(sender)] = answer, holder
    return answers


def receive_datagram(server: socket.socket, size: int) -> tuple[bytes, Holder, str | bytes | None]:
    """Return a datagram of a socket of `bind_datagrams`, its sender, and the sender's address."""
    space = socket.CMSG_SPACE(struct.calcsize(_CREDENTIALS))
    payload, ancillary, _, sender = server.recvmsg(size, space)
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            pid, user, _ = struct.unpack(_CREDENTIALS, data)
            return payload, Holder(pid, user), sender
    return payload, Holder(0, -1), sender


def _address(name: str) -> bytes:
    """Return the address of a name; that of an empty name lets the kernel choose one."""
    if not name:
        return b""
    address = b"\0" + os.fsencode(f"{_PREFIX}/{name}")
    if len(address) > _MAX_NAME_BYTES + 1:  # such as the name of a long path
        import hashlib

        digest = hashlib.blake2b(address, digest_size=24).hexdigest()
        address = f"\0{_PREFIX}/{digest}".encode()
    return address
