"""Server of requests, which gateways pass on or which come directly."""

import asyncio
import logging
import math
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Any

from fishd.core import protocol, text
from fishd.core.errors import Refused
from fishd.daemon.gateway import link

log = logging.getLogger(__name__)

Perform = Callable[[str, dict[str, Any]], Awaitable[Any]]

MAX_REQUEST_RATE = 600.0
"""Largest rate of requests from all clients [1/s]; further requests wait in the gateway."""
_SEND_RETRY_S = 0.01
"""Time until a reply is sent again after the link to the gateway was full [s]."""


class ControlServer:
    """Server that performs requests, each in a separate task, with a limited number per tick."""

    def __init__(self, perform: Perform, tick: float) -> None:
        """tick: period of the loop [s]"""
        self._perform = perform
        self._per_tick = max(1, math.floor(MAX_REQUEST_RATE * tick))
        self._remaining = self._per_tick
        self._tasks: set[asyncio.Task[None]] = set()
        self.read: Callable[[bool], object] = lambda enabled: None
        """Function that enables or disables reading further requests from the gateways."""

    def take(self, send: Callable[[bytes], bool], message: bytes) -> None:
        """Start to answer a request that came over a link.

        send: function that sends a message over that link at once; False if the link is full
        """
        self._remaining -= 1
        if self._remaining <= 0:
            self.read(False)
        task = asyncio.create_task(self._answer(send, *link.number_and_payload(message)))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def end_tick(self) -> None:
        """Permit further requests, at the end of a tick."""
        if self._remaining <= 0:
            self.read(True)
        self._remaining = self._per_tick

    def close(self) -> None:
        """Cancel all requests that are not answered yet; may be called twice."""
        for task in self._tasks:
            task.cancel()

    async def _answer(self, send: Callable[[bytes], bool], number: int, payload: bytes) -> None:
        for part in link.reply(number, await self._reply(1e-9 * number, payload)):
            while not send(part):  # an incomplete reply keeps its request open
                await asyncio.sleep(_SEND_RETRY_S)

    async def reply_directly(self, payload: bytes) -> bytes:
        """Carry out a request that came without a gateway, which only few operations may."""
        return await self._reply(time.monotonic(), payload, protocol.DIRECT_OPERATIONS)

    async def _reply(
        self, received: float, payload: bytes, permitted: Collection[str] | None = None
    ) -> bytes:
        identity: protocol.RequestId = None
        try:
            request = protocol.decode_request(payload)
            identity = request.id
            if permitted is not None and request.op not in permitted:
                raise Refused("unknown-op", f"this socket accepts only {', '.join(permitted)}")
            _check_age(request.op, time.monotonic() - received)
            return protocol.success(identity, await self._perform(request.op, request.args))
        except Refused as error:
            return protocol.failure(identity, error)
        except Exception as error:
            log.exception("a request failed")
            internal = Refused("internal", f"fishd failed: {text.describe_error(error)}")
            return protocol.failure(identity, internal)


def _check_age(operation: str, seconds: float) -> None:
    """Raise `Refused` for an old request that would start to move the fish unexpectedly."""
    if operation in protocol.MOVING_OPERATIONS and seconds > protocol.MAX_WAIT_S:
        raise Refused(
            "stale",
            f"this {operation} waited for {seconds:.0f} s, as fishd stood still or was flooded;"
            " send it again",
        )
