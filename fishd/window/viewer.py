"""A page that is open: the messages that are sent over its WebSocket, and those that it sends."""

import asyncio
from collections.abc import Iterable
from contextlib import suppress

from aiohttp import WSMsgType, web

CLOSE_TIMEOUT_S = 0.4
"""Half of the longest time that a page may take to close [s]."""
MIN_MESSAGE_PERIOD_S = 0.02
"""Shortest mean time between two messages from a page; more wait in the network [s]."""
MAX_MESSAGES_AT_ONCE = 50
"""Number of messages from a page after a pause that are read without delay; after as many, other
connections are served."""


class Viewer:
    """One open WebSocket; `take` returns the messages that are sent next."""

    OPCODE = WSMsgType.BINARY
    """Kind of the messages that are bytes."""
    kind = "page"
    """Kind of viewer; each kind has a largest number of its own."""
    address = ""
    """Address of the page."""
    device_id = ""
    """Identifier of the paired device; empty for a browser on this machine."""

    def __init__(self) -> None:
        self._waiting, self._ended = asyncio.Event(), asyncio.Event()

    def take(self) -> Iterable[str | bytes]:
        """Return the messages that wait, and forget them."""
        raise NotImplementedError

    def receive(self, message: str) -> None:
        """Handle a text from the page; by default, ignore it."""

    def wake(self) -> None:
        """Send what waits, as soon as the page has taken what was sent before."""
        self._waiting.set()

    def end(self) -> None:
        """Close the page."""
        self._ended.set()

    async def serve(self, sock: web.WebSocketResponse, transport: asyncio.Transport) -> None:
        """Send messages until the page or the server closes, whether or not the page reads them."""
        jobs = (self._talk(sock), self._listen(sock, transport), self._ended.wait())
        tasks = [asyncio.create_task(job) for job in jobs]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception) and not isinstance(result, ConnectionError):
                raise result
        with suppress(TimeoutError):
            async with asyncio.timeout(2.0 * CLOSE_TIMEOUT_S):
                await sock.close(drain=False)

    async def _talk(self, sock: web.WebSocketResponse) -> None:
        self._waiting.set()
        while not sock.closed:
            await self._waiting.wait()
            self._waiting.clear()
            for message in self.take():
                if isinstance(message, str):
                    await sock.send_str(message)
                else:
                    await sock.send_frame(message, self.OPCODE)

    async def _listen(self, sock: web.WebSocketResponse, transport: asyncio.Transport) -> None:
        """Read messages, and detect that the page is closed.

        Where too many come, nothing more is read from the page for a time.
        """
        loop = asyncio.get_running_loop()
        due, is_paused = loop.time(), False

        def resume() -> None:
            nonlocal is_paused
            if (wait := due - loop.time()) > 0.0:
                loop.call_later(wait, resume)
                return
            is_paused = False
            transport.resume_reading()

        count = 0
        async for message in sock:
            if message.type is WSMsgType.ERROR:
                break
            if message.type is WSMsgType.TEXT:
                self.receive(message.data)
            elif message.type is WSMsgType.PING:
                await sock.pong(message.data)
            due = max(due, loop.time() - MAX_MESSAGES_AT_ONCE * MIN_MESSAGE_PERIOD_S)
            due += MIN_MESSAGE_PERIOD_S
            if due > loop.time() and not is_paused:
                is_paused = True
                transport.pause_reading()
                resume()
            count += 1
            if count % MAX_MESSAGES_AT_ONCE == 0:
                await asyncio.sleep(0.0)
