"""Server of the page: three files, and a WebSocket that sends pictures and facts.

No request changes anything. The server refuses requests for a host name that is not one of this
machine, and WebSockets from pages of other origins; otherwise any web page open in a browser on
this network could read the camera's pictures.
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

MAX_VIEWERS = 16
"""Largest number of pages that are served at a time."""
MAX_VIEWERS_PER_ADDRESS = 12
"""Largest number of pages of one address."""
MAX_CONNECTIONS = 64
"""Largest number of connections; a further one replaces one that has not sent a request."""
MAX_ASKING_PER_ADDRESS = 16
"""Largest number of connections of one address that have not sent a request."""
REQUEST_TIMEOUT_S = 3.0
"""Longest time until a connection has sent its request, to the end of the headers [s]."""
LOG_PERIOD_S = 1.0
"""Shortest time between two lines in the log about malformed requests [s]."""
HEARTBEAT_PERIOD_S = 10.0
"""Period of pings to a page, which must answer within half of it [s]."""
CLOSE_TIMEOUT_S = 0.4
"""Half of the longest time that open requests may take when the server closes [s]."""
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
    """Server of the page of one camera; an asynchronous context manager in one event loop."""

    def __init__(self, host: str, port: int) -> None:
        """host: address to listen at; port: 0 for any free port"""
        self._host, self._port = host, port
        self._viewers: set[_Viewer] = set()
        self._facts = b"{}"
        self._picture: bytes | None = None
        self._asking: dict[web.RequestHandler, str] = {}
        """Connections that have not sent a request, oldest first, and their addresses."""
        self._names = {socket.gethostname().lower(), "localhost"}
        self._names |= {f"{name}.local" for name in self._names}

    async def __aenter__(self) -> "PageServer":
        """Listen; raises `StartupError`."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        for path, (name, kind) in _FILES.items():
            app.router.add_get(path, _file_handler(name, kind))
        app.router.add_get("/live", self._live)
        self._runner = web.AppRunner(
            app,
            access_log=None,
            handle_signals=False,
            keepalive_timeout=REQUEST_TIMEOUT_S,
            lingering_time=CLOSE_TIMEOUT_S,
            logger=_RequestLog(log, {}),
            shutdown_timeout=CLOSE_TIMEOUT_S,
        )
        await self._runner.setup()
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(self._connected, self._host, self._port)
        except OSError as error:
            await self._runner.cleanup()
            number = error.errno or 0  # negative for errors of the resolver
            reason = os.strerror(number) if number > 0 else error.strerror or error
            raise StartupError(
                f"cannot serve a page at {self._host}:{self._port}: {reason}; "
                "name another port with --port"
            ) from None
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close all pages, and abort connections that do not close."""
        self._server.close()
        for viewer in tuple(self._viewers):
            viewer.end()
        server = self._runner.server
        transports = [connection.transport for connection in server.connections] if server else []
        await self._runner.cleanup()
        for transport in transports:
            if isinstance(transport, asyncio.WriteTransport):
                transport.abort()  # close() would wait for a page that never reads

    @property
    def url(self) -> str:
        """Address of the page."""
        host, port = self._server.sockets[0].getsockname()[:2]
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/"

    def show(self, news: News) -> None:
        """Send an update to all pages."""
        self._facts = news.facts
        if news.jpeg is not None:
            self._picture = news.jpeg
        for viewer in self._viewers:
            viewer.show(news)

    def _connected(self) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        return _Door(self._admit)

    def _admit(self, transport: asyncio.Transport) -> None:
        """Serve a connection, and end another one where there are too many."""
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
        elif len(server.connections) >= MAX_CONNECTIONS:
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
                raise web.HTTPForbidden(text="this is not a name of this machine\n")
            response = await handler(request)
        except web.HTTPException as error:
            error.headers.update(_HEADERS)
            error.force_close()
            raise
        if not response.prepared:
            response.headers.update(_HEADERS)
            response.force_close()  # an idle connection would take the place of others
        return response

    def _is_ours(self, host: str) -> bool:
        """Return whether a host, with or without port, is an address or a name of this machine."""
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
        if origin is not None and _origin_host(origin) != request.host.lower():
            raise web.HTTPForbidden(text="this page has another origin\n")
        address = request.remote or ""
        own = sum(viewer.address == address for viewer in self._viewers)
        if len(self._viewers) >= MAX_VIEWERS or own >= MAX_VIEWERS_PER_ADDRESS:
            raise web.HTTPServiceUnavailable(
                text=f"{len(self._viewers)} pages are open already, {own} of them from {address}; "
                "close one of them\n"
            )
        sock = web.WebSocketResponse(
            timeout=CLOSE_TIMEOUT_S, heartbeat=HEARTBEAT_PERIOD_S, max_msg_size=1024, compress=False
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
    """One open page; a slow one misses updates."""

    def __init__(self, sock: web.WebSocketResponse, address: str, first: News) -> None:
        self.address = address
        self._sock = sock
        self._news: News | None = first
        self._waiting = asyncio.Event()
        self._waiting.set()
        self._ended = False

    def show(self, news: News) -> None:
        """Send an update next; it replaces one that still waits, but not the picture by none."""
        pending = self._news
        if news.jpeg is None and pending is not None:
            news = News(news.facts, pending.jpeg)
        self._news = news
        self._waiting.set()

    def end(self) -> None:
        """Close the page."""
        self._ended = True
        self._waiting.set()

    async def serve(self) -> None:
        """Send updates until the page or the server closes."""
        listening = asyncio.create_task(self._listen())
        try:
            while not self._ended and not self._sock.closed:
                await self._waiting.wait()
                self._waiting.clear()
                news, self._news = self._news, None
                if news is not None and not self._sock.closed:
                    await self._sock.send_bytes(_encode_news(news))
        except ConnectionError:
            pass
        finally:
            listening.cancel()
        await self._sock.close()

    async def _listen(self) -> None:
        """Detect that the page is closed; its messages are ignored."""
        async for message in self._sock:
            if message.type is WSMsgType.ERROR:
                break
        self.end()


class _Door(asyncio.Protocol):
    """Protocol of a connection until it is admitted, which depends on its address."""

    def __init__(self, admit: Callable[[asyncio.Transport], None]) -> None:
        self._admit = admit

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Admit the connection."""
        assert isinstance(transport, asyncio.Transport)
        self._admit(transport)


class _RequestLog(logging.LoggerAdapter[logging.Logger]):
    """Log of the HTTP server, without tracebacks for malformed requests."""

    _next_line = 0.0
    _left_out = 0

    def exception(self, msg: object, *args: Any, exc_info: Any = True, **options: Any) -> None:
        """Log an error of the server with its traceback, a malformed request in one line."""
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
        kind = type(error).__name__  # the text of the error quotes the request
        self.logger.debug("%s sent a malformed request: %s%s", address, kind, more)


def _encode_news(news: News) -> bytes:
    """Return an update as one message: length of the facts, the facts, and the JPEG."""
    return len(news.facts).to_bytes(4, "big") + news.facts + (news.jpeg or b"")


def _origin_host(origin: str) -> str:
    """Return host and port of an origin; empty where it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _file_handler(name: str, kind: str) -> Handler:
    content = resources.files(__package__).joinpath(name).read_bytes()

    async def serve_file(_: web.Request) -> web.StreamResponse:
        return web.Response(body=content, content_type=kind, charset="utf-8")

    return serve_file
