"""Serves the page: three files, and a WebSocket that sends pictures and facts.

It takes no request that changes anything. Who asks by a name that is none of this machine's is
refused, and so is a page from elsewhere that opens the WebSocket: else any page on the web that
somebody looks at here could read what the camera sees.
"""

import asyncio
import ipaddress
import logging
import os
import socket
import time
from collections.abc import Awaitable, Callable
from importlib import resources
from typing import Any
from urllib.parse import urlsplit

from aiohttp import WSMsgType, http_exceptions, web

from fishd.camera.page.feed import News
from fishd.core.errors import StartupError

log = logging.getLogger(__name__)

MOST_VIEWERS = 16
"""Pages that are served at a time."""
MAX_VIEWERS_PER_ADDRESS = 12
"""Largest number of them that one address may have."""
MOST_CONNECTIONS = 64
"""Largest number of connections; a new one takes the place of one that has sent no request."""
MAX_ASKING_PER_ADDRESS = 16
"""Largest number of connections of one address that have sent no request."""
REQUEST_TIMEOUT_S = 3.0
"""Time that a connection has to send its request, to the end of the headers [s]."""
LOG_PERIOD_S = 1.0
"""Shortest time between two lines in the log about malformed requests [s]."""
HEARTBEAT = 10.0
"""A page that does not answer within half of this is gone [s]."""
LEAVING = 0.4
"""What is under way at the end may take twice so long [s]."""
_FILES = {
    "/": ("page.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class PageServer:
    """The page of one camera; an asynchronous context manager. All of it runs in one loop."""

    def __init__(self, host: str, port: int) -> None:
        """host: address to listen at; port: 0 takes any"""
        self._host, self._port = host, port
        self._viewers: set[_Viewer] = set()
        self._facts = b"{}"
        self._picture: bytes | None = None
        self._asking: dict[web.RequestHandler, str] = {}
        """Connections that have sent no request yet, the oldest first, and their addresses."""
        self._names = {socket.gethostname().lower(), "localhost"}
        self._names |= {f"{name}.local" for name in self._names}

    async def __aenter__(self) -> "PageServer":
        """Listen; raises `StartupError`."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        for path, (name, kind) in _FILES.items():
            app.router.add_get(path, _file(name, kind))
        app.router.add_get("/live", self._live)
        self._runner = web.AppRunner(
            app,
            access_log=None,
            handle_signals=False,
            keepalive_timeout=REQUEST_TIMEOUT_S,
            lingering_time=LEAVING,
            logger=_RequestLog(log, {}),
            shutdown_timeout=LEAVING,
        )
        await self._runner.setup()
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._connected, self._host, self._port)
        except OSError as error:
            await self._runner.cleanup()
            number = error.errno or 0  # below 0 of the resolver
            why = os.strerror(number) if number > 0 else error.strerror or error
            raise StartupError(
                f"cannot serve a page at {self._host}:{self._port}: {why}; "
                "name another port with --port"
            ) from None
        return self

    async def __aexit__(self, *_: object) -> None:
        """Say goodbye to all pages, and close what does not listen."""
        self._server.close()
        for viewer in tuple(self._viewers):
            viewer.end()
        server = self._runner.server
        transports = [each.transport for each in server.connections] if server else []
        await self._runner.cleanup()
        for transport in transports:
            if isinstance(transport, asyncio.WriteTransport):
                transport.abort()  # closed, it would still wait for a page that never reads

    @property
    def url(self) -> str:
        """Where the page is."""
        host, port = self._server.sockets[0].getsockname()[:2]
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/"

    def show(self, news: News) -> None:
        """Let every page show this."""
        self._facts = news.facts
        if news.jpeg is not None:
            self._picture = news.jpeg
        for viewer in self._viewers:
            viewer.show(news)

    def _connected(self) -> asyncio.Protocol:
        """Return what talks to a client that has just connected."""
        return _Door(self._admit)

    def _admit(self, transport: asyncio.Transport) -> None:
        """Serve a connection, in the place of another one where there are too many."""
        server = self._runner.server
        assert server
        address = str((transport.get_extra_info("peername") or ("",))[0])
        asking = self._asking = {
            handler: owner for handler, owner in self._asking.items() if handler.transport
        }
        owners = list(asking.values())
        crowded = ""
        if owners.count(address) >= MAX_ASKING_PER_ADDRESS:
            crowded = address
        elif len(server.connections) >= MOST_CONNECTIONS:
            crowded = max(owners, key=owners.count, default="")
            if not crowded:
                transport.abort()
                return
        if crowded:
            self._end(next(handler for handler, owner in asking.items() if owner == crowded))
        handler = server()
        asking[handler] = address
        transport.set_protocol(handler)
        handler.connection_made(transport)
        asyncio.get_running_loop().call_later(REQUEST_TIMEOUT_S, self._end, handler)

    def _end(self, handler: web.RequestHandler) -> None:
        """End a connection unless it has sent a request."""
        if self._asking.pop(handler, None) and isinstance(handler.transport, asyncio.Transport):
            handler.transport.abort()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        self._asking.pop(request.protocol, None)
        try:
            if not self._is_ours(request.host):
                raise web.HTTPForbidden(text="this machine has another name\n")
            response = await handler(request)
        except web.HTTPException as error:
            error.headers.update(_HEADERS)
            error.force_close()
            raise
        if not response.prepared:
            response.headers.update(_HEADERS)
            response.force_close()  # a connection kept alive would take the place of others
        return response

    def _is_ours(self, host: str) -> bool:
        """Is a host, with or without a port, an address, or a name of this machine?"""
        try:
            parts = urlsplit(f"//{host}")
            name, _ = parts.hostname or "", parts.port
        except ValueError:
            return False
        if "@" in host or parts.netloc != host:
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return True

    async def _live(self, request: web.Request) -> web.StreamResponse:
        origin = request.headers.get("Origin")
        if origin is not None and _place(origin) != request.host.lower():
            raise web.HTTPForbidden(text="a page from elsewhere\n")
        address = request.remote or ""
        own = sum(viewer.address == address for viewer in self._viewers)
        if len(self._viewers) >= MOST_VIEWERS or own >= MAX_VIEWERS_PER_ADDRESS:
            raise web.HTTPServiceUnavailable(
                text=f"{len(self._viewers)} pages are open already, {own} of them by {address}; "
                "close another one\n"
            )
        sock = web.WebSocketResponse(
            timeout=LEAVING, heartbeat=HEARTBEAT, max_msg_size=1024, compress=False
        )
        viewer = _Viewer(sock, address, News(self._facts, self._picture))
        self._viewers.add(viewer)
        try:
            await sock.prepare(request)
            await viewer.serve()
        finally:
            self._viewers.discard(viewer)
        return sock


class _Viewer:
    """One page; what it is too slow for it does not get."""

    def __init__(self, sock: web.WebSocketResponse, address: str, first: News) -> None:
        self.address = address
        self._sock = sock
        self._news: News | None = first
        self._waiting = asyncio.Event()
        self._waiting.set()
        self._ended = False

    def show(self, news: News) -> None:
        """Send this next; a picture that still waits gives way to a newer one."""
        waits = self._news
        if news.jpeg is None and waits is not None:
            news = News(news.facts, waits.jpeg)
        self._news = news
        self._waiting.set()

    def end(self) -> None:
        """Say goodbye."""
        self._ended = True
        self._waiting.set()

    async def serve(self) -> None:
        """Send until the page is gone, or the server ends."""
        listening = asyncio.create_task(self._listen())
        try:
            while not self._ended and not self._sock.closed:
                await self._waiting.wait()
                self._waiting.clear()
                news, self._news = self._news, None
                if news is not None and not self._sock.closed:
                    await self._sock.send_bytes(_joined(news))
        except ConnectionError:
            pass
        finally:
            listening.cancel()
        await self._sock.close()

    async def _listen(self) -> None:
        """Notice that the page is gone; nothing that it says is wanted."""
        async for message in self._sock:
            if message.type is WSMsgType.ERROR:
                break
        self.end()


class _Door(asyncio.Protocol):
    """The protocol of a connection until it is admitted, which needs its address."""

    def __init__(self, admit: Callable[[asyncio.Transport], None]) -> None:
        self._admit = admit

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Pass the connection on."""
        assert isinstance(transport, asyncio.Transport)
        self._admit(transport)


class _RequestLog(logging.LoggerAdapter[logging.Logger]):
    """The log of the HTTP server, without tracebacks for what clients send."""

    _next_line = 0.0
    _left_out = 0

    def exception(self, msg: object, *args: Any, exc_info: Any = True, **options: Any) -> None:
        """Log an error of this server with its traceback, a malformed request in one line."""
        if isinstance(exc_info, http_exceptions.HttpProcessingError):
            self._log_malformed(args[0] if args else "", exc_info)
        else:
            super().exception(msg, *args, exc_info=exc_info, **options)

    def debug(self, msg: object, *args: Any, exc_info: Any = None, **options: Any) -> None:
        """Log a malformed request in one line."""
        if isinstance(exc_info, http_exceptions.HttpProcessingError):
            self._log_malformed(args[0] if args else "", exc_info)
        else:
            super().debug(msg, *args, exc_info=exc_info, **options)

    def _log_malformed(self, address: object, error: Exception) -> None:
        now = time.monotonic()
        if now < self._next_line:
            self._left_out += 1
            return
        more = f" ({self._left_out} more since the last line)" if self._left_out else ""
        self._next_line, self._left_out = now + LOG_PERIOD_S, 0
        kind = type(error).__name__  # its text quotes the request
        self.logger.debug("%s sent a malformed request: %s%s", address, kind, more)


def _joined(news: News) -> bytes:
    """One message, so that a picture and its axis belong together: length of the facts, these, and
    the JPEG.
    """
    return len(news.facts).to_bytes(4, "big") + news.facts + (news.jpeg or b"")


def _place(origin: str) -> str:
    """Host and port of an origin; empty where it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _file(name: str, kind: str) -> Handler:
    content = resources.files(__package__).joinpath(name).read_bytes()

    async def give(_: web.Request) -> web.StreamResponse:
        return web.Response(body=content, content_type=kind, charset="utf-8")

    return give
