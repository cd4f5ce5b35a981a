"""fishd's own sockets for an emergency stop and few other requests, which need no gateway.

A client sends a request there as one datagram if the control socket does not answer. One socket is
a file beside the control socket. The other is a name in the kernel, which no change of a folder
takes away. The kernel queues only a few datagrams, each of a limited size.
"""

import asyncio
import grp
import logging
import os
import pwd
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

from fishd.core import protocol
from fishd.core.process import kernel_names, unix_sockets
from fishd.core.process.kernel_names import Holder

log = logging.getLogger(__name__)

MEMBERS_PERIOD_S = 5.0
"""Shortest time between two reads of the system's list of groups [s]."""
_MAX_REFUSED = 16
"""Largest number of datagrams of other users that are read, and dropped, in a period.

More than the kernel queues.
"""

Perform = Callable[[bytes], Awaitable[bytes]]


class DirectSocket:
    """Socket that receives requests as datagrams, at most one in each period."""

    def __init__(self, server: socket.socket, perform: Perform, period: float) -> None:
        """Begin to read a bound socket; must be called in a running asyncio loop.

        perform: function that carries out or refuses a request and returns the reply
        period: shortest time between two requests [s]
        """
        self._socket = server
        self._perform = perform
        self._period = period
        self._events = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self._events.add_reader(server, self._take)

    def close(self) -> None:
        """Stop listening; may be called twice."""
        if self._socket.fileno() >= 0:
            self._events.remove_reader(self._socket)
            self._socket.close()

    def _resume(self) -> None:
        if self._socket.fileno() >= 0:
            self._events.add_reader(self._socket, self._take)

    def _take(self) -> None:
        if received := self._receive():
            self._pause()
            self._task = self._events.create_task(self._answer(*received))

    def _pause(self) -> None:
        """Read nothing more for a period."""
        self._events.remove_reader(self._socket)
        self._events.call_later(self._period, self._resume)

    def _receive(self) -> tuple[bytes, str | bytes | None] | None:
        """Return a request and the address of its client; None without a permitted one."""
        try:
            return self._socket.recvfrom(protocol.MAX_MESSAGE)
        except OSError:
            return None

    async def _answer(self, payload: bytes, sender: str | bytes | None) -> None:
        reply = await self._perform(payload)
        if sender:
            with suppress(OSError):  # the client has ended, or does not read
                self._socket.sendto(reply, sender)


class KernelSocket(DirectSocket):
    """Socket with a name in the kernel, for this user, root and the members of this group.

    Datagrams of other users are dropped without an answer.
    """

    def __init__(self, name: str, perform: Perform, period: float) -> None:
        """Listen at a name; raise OSError."""
        self._permitted = _permitted_users()
        self._reader: threading.Thread | None = None
        self._next_read = 0.0
        """Time from which on the list of groups may be read again [s, monotonic]."""
        super().__init__(kernel_names.bind_datagrams(name), perform, period)

    def _receive(self) -> tuple[bytes, str | bytes | None] | None:
        for _ in range(_MAX_REFUSED):
            try:
                payload, client, sender = kernel_names.receive_datagram(
                    self._socket, protocol.MAX_MESSAGE
                )
            except OSError:
                return None
            if client.user in self._permitted:
                return payload, sender
            self._read_members_again(client, payload, sender)
        self._pause()  # another user floods it
        return None

    def _read_members_again(
        self, client: Holder, payload: bytes, sender: str | bytes | None
    ) -> None:
        """Read the members of the group in a thread; answer a client that has joined it since."""
        now = time.monotonic()
        if now < self._next_read or (self._reader and self._reader.is_alive()):
            return
        self._next_read = now + MEMBERS_PERIOD_S

        def read() -> None:
            permitted = _permitted_users()
            with suppress(RuntimeError):  # the asyncio loop is closed
                self._events.call_soon_threadsafe(update, permitted)

        def update(permitted: set[int]) -> None:
            self._permitted = permitted
            if client.user in permitted and self._socket.fileno() >= 0:
                self._task = self._events.create_task(self._answer(payload, sender))

        self._reader = threading.Thread(target=read, name="members", daemon=True)
        self._reader.start()


def open_at_file(path: Path, perform: Perform, period: float) -> DirectSocket:
    """Return a socket at a path next to a socket that is `claimed`; raise OSError or ValueError.

    Only this user and the group of this process may connect.
    """
    server = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        server.setblocking(False)
        unix_sockets.check_length(str(path))
        unix_sockets.bind(server, path, unix_sockets.GROUP_MASK)
    except (OSError, ValueError):
        server.close()
        raise
    return DirectSocket(server, perform, period)


def open_in_kernel(name: str, perform: Perform, period: float) -> KernelSocket | None:
    """Return a socket at a name in the kernel; None if it cannot be made, which is logged."""
    try:
        return KernelSocket(name, perform, period)
    except OSError as error:
        log.warning(
            "no name in the kernel (%s), so this fishd is found only by the files of its sockets",
            error.strerror,
        )
        return None


def _permitted_users() -> set[int]:
    """Return root, this user, and the members of its group by the system's list of groups."""
    users = {0, os.geteuid()}
    with suppress(KeyError, OSError):
        for name in grp.getgrgid(os.getegid()).gr_mem:
            with suppress(KeyError):
                users.add(pwd.getpwnam(name).pw_uid)
    return users
