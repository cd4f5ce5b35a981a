"""The control channel: a ROUTER socket that answers requests, whatever it is sent."""

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable
from typing import Any

import zmq
import zmq.asyncio

from fishd import protocol
from fishd.addresses import bind
from fishd.errors import Refused

log = logging.getLogger(__name__)

Perform = Callable[[str, dict[str, Any]], Awaitable[Any]]


class ControlServer:
    """Takes `[id, "", json]` from REQ sockets and `[id, json]` from DEALER sockets."""

    def __init__(
        self, context: "zmq.Context[zmq.Socket[bytes]]", address: str, perform: Perform
    ) -> None:
        """Raises `StartupError` when the address cannot be bound."""
        self._perform = perform
        self._tasks: set[asyncio.Task[None]] = set()
        self._socket = zmq.asyncio.Context.shadow(context.underlying).socket(zmq.ROUTER)
        self._socket.set(zmq.MAXMSGSIZE, protocol.MAX_MESSAGE)
        self._socket.set(zmq.LINGER, 100)
        mask = os.umask(0o117)  # an ipc socket for user and group, nobody else
        try:
            bind(self._socket, address, key="control.address")
        finally:
            os.umask(mask)
        self.address = self._socket.get_string(zmq.LAST_ENDPOINT)

    async def run(self) -> None:
        """Answer requests until cancelled."""
        while True:
            frames = await self._socket.recv_multipart()
            envelope, payload = frames[:-1], frames[-1]
            if len(envelope) == 1 or (len(envelope) == 2 and not envelope[1]):
                task = asyncio.create_task(self._answer(envelope, payload))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
            # A flood of requests would otherwise keep the ticker from being served.
            await asyncio.sleep(0)

    def close(self) -> None:
        """Close the socket; may be called twice."""
        for task in self._tasks:
            task.cancel()
        self._socket.close()

    async def _answer(self, envelope: list[bytes], payload: bytes) -> None:
        identity: protocol.RequestId = None
        try:
            request = protocol.decode_request(payload)
            identity = request.id
            reply = protocol.success(identity, await self._perform(request.op, request.args))
        except Refused as error:
            if identity is None:
                identity = protocol.request_id(payload)
            reply = protocol.failure(identity, error)
        except Exception as error:
            log.exception("a request failed")
            internal = Refused("internal", f"fishd failed: {type(error).__name__}: {error}")
            reply = protocol.failure(identity, internal)
        # Never blocks: ROUTER drops what a peer does not take.
        await self._socket.send_multipart([*envelope, reply])
