"""Answers the requests that the gateway of the control channel lets through."""

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Container
from typing import Any

from fishd.core import protocol, text
from fishd.core.errors import Refused
from fishd.daemon.gateway import link

log = logging.getLogger(__name__)

Perform = Callable[[str, dict[str, Any]], Awaitable[Any]]

RATE = 600.0
"""Requests per second that are taken from all clients together; others wait in the gateway."""
_NO_ROOM = 0.01
"""Time until a reply is tried again for which the link to the gateway had no room [s]."""


class ControlServer:
    """Performs requests, each in a task of its own, and no more in a tick than it can bear."""

    def __init__(self, perform: Perform, tick: float) -> None:
        """tick: period of the loop [s]"""
        self._perform = perform
        self._per_tick = max(1, math.floor(RATE * tick))
        self._left = self._per_tick
        self._tasks: set[asyncio.Task[None]] = set()
        self.send: Callable[[bytes], bool] = lambda message: True
        """Takes a message for the gateway, without waiting; False if the pipe is full."""
        self.read: Callable[[bool], object] = lambda wanted: None
        """Says whether the gateway is to hand over more requests."""

    def take(self, message: bytes) -> None:
        """Begin to answer a request that came over the link."""
        self._left -= 1
        if self._left <= 0:
            self.read(False)
        task = asyncio.create_task(self._answer(*link.numbered(message)))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def ticked(self) -> None:
        """A tick is over: the next requests may come."""
        if self._left <= 0:
            self.read(True)
        self._left = self._per_tick

    def close(self) -> None:
        """Give up what is not answered yet; may be called twice."""
        for task in self._tasks:
            task.cancel()

    async def _answer(self, number: int, payload: bytes) -> None:
        for part in link.reply(number, await self._reply(1e-9 * number, payload)):
            while not self.send(part):  # a reply that is not whole would never make room for more
                await asyncio.sleep(_NO_ROOM)

    async def reply_to_estop(self, payload: bytes) -> bytes:
        """Carry out a request for an emergency stop, and refuse any other one."""
        return await self._reply(time.monotonic(), payload, {"estop"})

    async def _reply(
        self, came: float, payload: bytes, permitted: Container[str] | None = None
    ) -> bytes:
        identity: protocol.RequestId = None
        try:
            request = protocol.decode_request(payload)
            identity = request.id
            if permitted is not None and request.op not in permitted:
                raise Refused("unknown-op", "this socket takes nothing but estop")
            _check_age(request.op, time.monotonic() - came)
            return protocol.success(identity, await self._perform(request.op, request.args))
        except Refused as error:
            return protocol.failure(identity, error)
        except Exception as error:
            log.exception("a request failed")
            internal = Refused("internal", f"fishd failed: {text.named(error)}")
            return protocol.failure(identity, internal)


def _check_age(operation: str, seconds: float) -> None:
    """Raises `Refused` for what would begin to move a fish that was left alone meanwhile."""
    if operation in protocol.BEGINNINGS and seconds > protocol.WAITED:
        raise Refused(
            "stale",
            f"this {operation} waited for {seconds:.0f} s, as fishd stood still or was flooded;"
            " ask again",
        )
