"""Separate socket for an emergency stop, next to the control socket; it needs no gateway.

A client sends the request `estop` there as one datagram if the control socket does not answer. The
kernel queues only a few datagrams, each of a limited size, and fishd reads one per tick.
"""

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from fishd.core import protocol
from fishd.core.process import unix_sockets

log = logging.getLogger(__name__)


class EstopSocket:
    """Datagram socket that the asyncio loop reads."""

    def __init__(
        self, path: Path, perform: Callable[[bytes], Awaitable[bytes]], period: float
    ) -> None:
        """Listen at a path next to a socket that is `claimed`, or log why that is not possible.

        perform: function that carries out or refuses a request and returns the reply
        period: shortest time between two requests [s]
        """
        self._perform = perform
        self._period = period
        self._events = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self._stack = ExitStack()
        self._socket = self._stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._socket.setblocking(False)
        try:
            unix_sockets.check_length(str(path))
            unix_sockets.bind(self._socket, path, unix_sockets.GROUP_MASK)
        except (OSError, ValueError) as error:
            log.warning(
                "%s: not available, so an emergency stop needs the control socket: %s", path, error
            )
            self._stack.close()
            return
        self._stack.callback(path.unlink, missing_ok=True)
        self._stack.callback(self._pause)
        self._resume()

    def close(self) -> None:
        """Stop listening; may be called twice."""
        self._stack.close()

    def _resume(self) -> None:
        if self._socket.fileno() >= 0:
            self._events.add_reader(self._socket, self._take)

    def _pause(self) -> None:
        self._events.remove_reader(self._socket)

    def _take(self) -> None:
        try:
            payload, sender = self._socket.recvfrom(protocol.MAX_MESSAGE)
        except OSError:
            return
        self._pause()
        self._task = self._events.create_task(self._answer(payload, sender))
        self._events.call_later(self._period, self._resume)

    async def _answer(self, payload: bytes, sender: str | bytes | None) -> None:
        reply = await self._perform(payload)
        if sender:
            with suppress(OSError):  # the client has ended, or does not read
                self._socket.sendto(reply, sender)
