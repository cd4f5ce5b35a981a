"""Server of web pages: files, requests and WebSockets, with guards against other web pages.

It refuses requests for a host name that is not one of this machine, and WebSockets and changes from
pages of other origins; otherwise any web page open in a browser on this network could read what
the pages show, or send their requests.
"""

import asyncio
import gzip
import hashlib
import ipaddress
import logging
import os
import socket
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Set
from importlib.resources.abc import Traversable
from itertools import islice
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from aiohttp import WSMsgType, http_exceptions, web

from fishd.core.errors import StartupError

log = logging.getLogger(__name__)

MAX_VIEWERS = 16
"""Largest number of WebSockets that are served at a time."""
MAX_VIEWERS_PER_ADDRESS = 12
"""Largest number of WebSockets of one address."""
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
MAX_MESSAGE_BYTES = 1024
"""Largest size of a message from a page [bytes]."""
MIN_COMPRESSED_BYTES = 1024
"""Smallest size of a file that is sent compressed [bytes]."""
_CONTENT_TYPES = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class WebServer:
    """Server of one address; an asynchronous context manager in one event loop."""

    def __init__(
        self,
        host: str,
        port: int,
        routes: Iterable[web.AbstractRouteDef],
        *,
        names: Iterable[str] = (),
        middlewares: Iterable[Any] = (),
        readers: Mapping[str, Set[str]] | None = None,
        max_body_bytes: int = 1024,
        advice: str = "name another port with --port",
    ) -> None:
        """
        host: address to listen at; port: 0 for any free port
        names: further host names by which this machine is reached
        middlewares: those of aiohttp that get what the guards refuse, too
        readers: origins of other pages that may open a WebSocket, by its path
        advice: remedy where the port cannot be taken
        """
        self._host, self._port, self._advice = host, port, advice
        self._readers = readers or {}
        self.viewers: set[Viewer] = set()
        """Open WebSockets."""
        self._asking: dict[web.RequestHandler, tuple[str, asyncio.TimerHandle]] = {}
        """Address and timeout of each connection that has not sent a request, oldest first."""
        self._names = {socket.gethostname().lower(), "localhost"}
        self._names |= {f"{name}.local" for name in self._names}
        self._names |= {name.lower() for name in names}
        self._app = web.Application(
            middlewares=[*middlewares, self._guard], client_max_size=max_body_bytes
        )
        self._app.router.add_routes(routes)

    async def __aenter__(self) -> "WebServer":
        """Listen; raises `StartupError`."""
        self._runner = web.AppRunner(
            self._app,
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
                f"cannot serve a page at {self._host}:{self._port}: {reason}; {self._advice}"
            ) from None
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close all pages, and abort connections that do not close."""
        self._server.close()
        for viewer in tuple(self.viewers):
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

    async def serve_viewer(
        self, request: web.Request, viewer: "Viewer", protocols: Iterable[str] = ()
    ) -> web.StreamResponse:
        """Serve a WebSocket until the page or the server closes it."""
        viewer.address = request.remote or ""
        own = sum(other.address == viewer.address for other in self.viewers)
        if len(self.viewers) >= MAX_VIEWERS or own >= MAX_VIEWERS_PER_ADDRESS:
            raise web.HTTPServiceUnavailable(
                text=f"{len(self.viewers)} pages are open already, {own} of them from "
                f"{viewer.address}; close one of them\n"
            )
        sock = web.WebSocketResponse(
            protocols=protocols,
            timeout=CLOSE_TIMEOUT_S,
            heartbeat=HEARTBEAT_PERIOD_S,
            max_msg_size=MAX_MESSAGE_BYTES,
            compress=False,
        )
        self.viewers.add(viewer)
        try:
            await sock.prepare(request)
            await viewer.serve(sock)
        finally:
            self.viewers.discard(viewer)
        return sock

    def _connected(self) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        return _Door(self._admit)

    def _admit(self, transport: asyncio.Transport) -> None:
        """Serve a connection, and end another one where there are too many."""
        server = self._runner.server
        assert server
        address = str((transport.get_extra_info("peername") or ("",))[0])
        for handler in [handler for handler in self._asking if not handler.transport]:
            self._forget(handler)
        owners = [owner for owner, _ in self._asking.values()]
        crowded = ""
        if owners.count(address) >= MAX_ASKING_PER_ADDRESS:
            crowded = address
        elif len(server.connections) >= MAX_CONNECTIONS:
            crowded = max(owners, key=owners.count, default="")
            if not crowded:
                transport.abort()
                return
        if crowded:
            place = owners.index(crowded)
            self._end(next(islice(self._asking, place, None)))
        handler = server()
        timeout = asyncio.get_running_loop().call_later(REQUEST_TIMEOUT_S, self._end, handler)
        self._asking[handler] = address, timeout
        transport.set_protocol(handler)
        handler.connection_made(transport)

    def _end(self, handler: web.RequestHandler) -> None:
        """End a connection that has not sent a request."""
        self._forget(handler)
        if isinstance(handler.transport, asyncio.Transport):
            handler.transport.abort()

    def _forget(self, handler: web.RequestHandler) -> None:
        """Count a connection no longer among those that have not sent a request."""
        _, timeout = self._asking.pop(handler, ("", None))
        if timeout:
            timeout.cancel()  # it would keep the connection in memory

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        self._forget(request.protocol)
        try:
            if not self._is_ours(request.host):
                raise web.HTTPForbidden(text="this is not a name of this machine\n")
            if request.match_info.http_exception is None:
                check_origin(request, self._readers.get(request.path, frozenset()))
            response = await handler(request)
        except web.HTTPException as error:
            finish(error)
            raise
        if not response.prepared:
            finish(response)
        return response

    def _is_ours(self, host: str) -> bool:
        """Return whether a host, with or without port, is an address or a name of this machine."""
        name = host_name(host)
        return parse_ip(name) is not None or name in self._names


class Viewer:
    """One open WebSocket; `take` returns the messages that are sent next."""

    OPCODE = WSMsgType.BINARY
    """Kind of the messages that are bytes."""
    address = ""
    """Address of the page."""
    device_id = ""
    """Identifier of the paired device; empty for a browser on this machine."""

    def __init__(self) -> None:
        self._waiting = asyncio.Event()
        self._ended = False

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
        self._ended = True
        self._waiting.set()

    async def serve(self, sock: web.WebSocketResponse) -> None:
        """Send messages until the page or the server closes."""
        listening = asyncio.create_task(self._listen(sock))
        self._waiting.set()
        try:
            while not self._ended and not sock.closed:
                await self._waiting.wait()
                self._waiting.clear()
                for message in self.take():
                    if self._ended or sock.closed:
                        break
                    if isinstance(message, str):
                        await sock.send_str(message)
                    else:
                        await sock.send_frame(message, self.OPCODE)
        except ConnectionError:
            pass
        finally:
            listening.cancel()
        await sock.close()

    async def _listen(self, sock: web.WebSocketResponse) -> None:
        """Read messages, and detect that the page is closed."""
        async for message in sock:
            if message.type is WSMsgType.ERROR:
                break
            if message.type is WSMsgType.TEXT:
                self.receive(message.data)
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
        """Log an error of the server with its traceback, a malformed request in one line.

        A page that closes before its answer is not an error of the server.
        """
        if isinstance(exc_info, http_exceptions.HttpProcessingError | ConnectionError):
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


def finish(response: web.StreamResponse) -> None:
    """Add the headers that all answers have, and close the connection after it."""
    response.headers.update(_HEADERS)
    response.headers.setdefault("Cache-Control", "no-store")
    response.force_close()  # an idle connection would take the place of others


def check_origin(request: web.Request, readers: Set[str] = frozenset()) -> None:
    """Raise `HTTPForbidden` for a WebSocket or a change that a page of another origin asks for.

    Browsers name the origin of both. A change without an origin is refused, too.

    readers: other origins that may open a WebSocket
    """
    origin = request.headers.get("Origin")
    changes = request.method not in ("GET", "HEAD")
    if origin is None and not changes:
        return
    if not changes and request.headers.get("Upgrade", "").lower() != "websocket":
        return  # browsers keep the answer from the other page
    if not changes and origin in readers:
        return
    if origin is None or _origin_host(origin) != request.host.lower():
        raise web.HTTPForbidden(text="this page has another origin\n")


def _origin_host(origin: str) -> str:
    """Return host and port of an origin; empty where it has none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def host_name(host: str) -> str:
    """Return the name or number in a Host header, in lower case; empty if it is malformed."""
    try:
        parts = urlsplit(f"//{host}")
        name, _ = parts.hostname or "", parts.port
    except ValueError:
        return ""
    return "" if "@" in host or parts.netloc != host else name


def parse_ip(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return an IP address; None for any other name."""
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def file_routes(folder: Traversable, index: str) -> Iterator[web.RouteDef]:
    """Yield a route for each file of a folder, at its path; `index` is at `/`."""
    for path, file in _walk(folder, PurePosixPath("/")):
        if path.suffix in _CONTENT_TYPES:
            handler = _file_handler(file.read_bytes(), _CONTENT_TYPES[path.suffix])
            yield web.get("/" if path == PurePosixPath("/", index) else str(path), handler)


def _walk(folder: Traversable, path: PurePosixPath) -> Iterator[tuple[PurePosixPath, Traversable]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _walk(entry, path / entry.name)
        else:
            yield path / entry.name, entry


def _file_handler(content: bytes, kind: str) -> Handler:
    """Return the handler of a file, which a browser needs to load only if it has changed."""
    compressed = gzip.compress(content, 9, mtime=0) if len(content) > MIN_COMPRESSED_BYTES else b""
    charset = "utf-8" if kind.startswith("text/") else None
    headers = {
        "ETag": f'"{hashlib.sha256(content).hexdigest()[:32]}"',
        "Cache-Control": "no-cache",
        "Vary": "Accept-Encoding",
    }

    async def serve_file(request: web.Request) -> web.StreamResponse:
        if request.headers.get("If-None-Match") == headers["ETag"]:
            return web.Response(status=304, headers=headers)
        if compressed and "gzip" in request.headers.get("Accept-Encoding", ""):
            encoded = {**headers, "Content-Encoding": "gzip"}
            return web.Response(
                body=compressed, content_type=kind, charset=charset, headers=encoded
            )
        return web.Response(body=content, content_type=kind, charset=charset, headers=headers)

    return serve_file
