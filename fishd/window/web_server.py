"""Server of web pages: files, requests and WebSockets, with guards against other web pages.

It refuses requests for a host name that is not one of this machine, and WebSockets and changes from
pages of other origins; otherwise any web page open in a browser on this network could read what
the pages show, or send their requests.
"""

import asyncio
import gzip
import hashlib
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Set
from importlib.resources.abc import Traversable
from pathlib import PurePosixPath
from typing import Any, Self
from urllib.parse import urlsplit

from aiohttp import http_exceptions, web

from fishd.core.errors import StartupError
from fishd.window.places import RECEIVE_BYTES, Places, parse_ip
from fishd.window.viewer import CLOSE_TIMEOUT_S, Viewer

log = logging.getLogger(__name__)

MAX_VIEWERS = 16
"""Largest number of WebSockets of one kind that are served at a time."""
MAX_VIEWERS_PER_ADDRESS = 12
"""Largest number of these of one address."""
BACKLOG = 1024
"""Number of connections that the kernel keeps until they are admitted."""
REFUSAL_DELAY_S = 1.0
"""Time until a page that is one too many is refused: it may come again at once [s]."""
REQUEST_TIMEOUT_S = 3.0
"""Longest time until a connection has sent its request, to the end of the headers [s]."""
HEARTBEAT_PERIOD_S = 10.0
"""Period of pings to a page, which must answer within half of it [s]."""
MAX_MESSAGE_BYTES = 1024
"""Largest size of a message from a page [bytes]."""
ESTOP = "estop"
"""Name of the route of an emergency stop; its connections are ended last."""
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
        is_paired: Callable[[web.Request], bool] = lambda request: False,
        max_body_bytes: int = 1024,
    ) -> None:
        """
        host: address to listen at; port: 0 for any free port
        names: further host names by which this machine is reached
        middlewares: those of aiohttp that get what the guards refuse, too
        readers: origins of other pages that may open a WebSocket, by its path
        is_paired: returns whether a request is from a paired device
        """
        self._host, self._port = host, port
        self._readers = readers or {}
        self.viewers: set[Viewer] = set()
        """Open WebSockets."""
        self._places = Places()
        self._is_paired, self._max_body_bytes = is_paired, max_body_bytes
        self._names = {socket.gethostname().lower(), "localhost"}
        self._names |= {f"{name}.local" for name in self._names}
        self._names |= {name.lower() for name in names}
        self._app = web.Application(
            middlewares=[*middlewares, self._guard], client_max_size=max_body_bytes
        )
        self._app.router.add_routes(routes)

    async def __aenter__(self) -> Self:
        """Listen; raises `StartupError`."""
        self._runner = web.AppRunner(
            self._app,
            access_log=None,
            auto_decompress=False,
            read_bufsize=RECEIVE_BYTES,
            handle_signals=False,
            keepalive_timeout=REQUEST_TIMEOUT_S,
            lingering_time=CLOSE_TIMEOUT_S,
            logger=_RequestLog(log, {}),
            shutdown_timeout=CLOSE_TIMEOUT_S,
        )
        await self._runner.setup()
        server, loop = self._runner.server, asyncio.get_running_loop()
        assert server
        try:
            self._server = await loop.create_server(
                asyncio.Protocol, self._host, self._port, start_serving=False
            )
            listeners = [listener.dup() for listener in self._server.sockets]
            for listener in listeners:  # its connections have the same size
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
                listener.setblocking(False)
                listener.listen(BACKLOG)
            self._places.open(listeners, server, REQUEST_TIMEOUT_S)
        except OSError as error:
            await self._runner.cleanup()
            number = error.errno or 0  # negative for errors of the resolver
            reason = os.strerror(number) if number > 0 else error.strerror or error
            raise StartupError(
                f"cannot serve a page at {self._host}:{self._port}: {reason}; name another one "
                "with --listen"
            ) from None
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close all pages, and abort connections that do not close."""
        self._server.close()
        self._places.close()
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
        self, request: web.Request, viewer: Viewer, protocols: Iterable[str] = ()
    ) -> web.StreamResponse:
        """Serve a WebSocket until the page or the server closes it."""
        viewer.address = request.remote or ""
        others = [other for other in self.viewers if other.kind == viewer.kind]
        own = sum(other.address == viewer.address for other in others)
        if len(others) >= MAX_VIEWERS or own >= MAX_VIEWERS_PER_ADDRESS:
            await asyncio.sleep(REFUSAL_DELAY_S)
            raise web.HTTPServiceUnavailable(
                text=f"{len(others)} {viewer.kind}s are open already, {own} of them from "
                f"{viewer.address}; close one of them\n"
            )
        sock = web.WebSocketResponse(
            protocols=protocols,
            timeout=CLOSE_TIMEOUT_S,
            autoclose=False,
            autoping=False,
            heartbeat=HEARTBEAT_PERIOD_S,
            max_msg_size=MAX_MESSAGE_BYTES,
            compress=False,
        )
        self.viewers.add(viewer)
        transport = request.transport
        try:
            await sock.prepare(request)
            self._places.leave(request.protocol)
            if transport:
                await viewer.serve(sock, transport)
        finally:
            self.viewers.discard(viewer)
            if transport and transport.get_write_buffer_size():
                transport.abort()  # close() would wait for a page that never reads
        return sock

    @web.middleware
    async def _guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        try:
            if not self._is_ours(request.host):
                raise web.HTTPForbidden(text="this is not a name of this machine\n")
            if request.match_info.http_exception is None:
                check_origin(request, self._readers.get(request.path, frozenset()))
            check_body(request, self._max_body_bytes)
            if self._is_paired(request):
                self._places.reserve(request.remote or "")
            if request.match_info.route.name == ESTOP:
                self._places.keep(request.protocol)
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


class _RequestLog(logging.LoggerAdapter[logging.Logger]):
    """Log of the HTTP server, without tracebacks for malformed requests.

    A page that closes before its answer is not an error of the server.
    """

    def exception(self, msg: object, *args: Any, exc_info: Any = True, **options: Any) -> None:
        """Log an error of the server with its traceback, a malformed request in one line."""
        if isinstance(exc_info, http_exceptions.HttpProcessingError | ConnectionError):
            self.debug(msg, *args, exc_info=exc_info)
        else:
            super().exception(msg, *args, exc_info=exc_info, **options)

    def debug(self, msg: object, *args: Any, exc_info: Any = None, **options: Any) -> None:
        """Log a malformed request in one line, which does not quote the request."""
        if exc_info:
            msg, args = (
                "malformed request from %s: %s",
                (args[0] if args else "", type(exc_info).__name__),
            )
        super().debug(msg, *args, **options)


def finish(response: web.StreamResponse) -> None:
    """Add the headers that all answers have, and close the connection after it."""
    response.headers.update(_HEADERS)
    response.headers.setdefault("Cache-Control", "no-store")
    response.force_close()  # an idle connection would take the place of others


def check_body(request: web.Request, max_bytes: int) -> None:
    """Raise `HTTPClientError` for a body that is compressed, too long, or of unknown length."""
    if "Content-Encoding" in request.headers:
        raise web.HTTPUnsupportedMediaType(text="Content-Encoding is not supported\n")
    if "Transfer-Encoding" in request.headers:
        raise web.HTTPLengthRequired(text="Content-Length is needed\n")
    length = request.content_length or 0
    if length > max_bytes:
        raise web.HTTPRequestEntityTooLarge(
            max_bytes, length, text=f"a body of at most {max_bytes} bytes is needed\n"
        )


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
