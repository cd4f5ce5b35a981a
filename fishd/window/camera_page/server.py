"""Server of the page of a camera: its files, and a WebSocket that sends pictures and a text.

No request changes anything.
"""

from collections.abc import Iterable
from importlib import resources

from aiohttp import web

from fishd.window.viewer import Viewer
from fishd.window.web_server import WebServer, file_routes


class PageServer(WebServer):
    """Server of the page of one camera; an asynchronous context manager in one event loop."""

    def __init__(self, host: str, port: int) -> None:
        """host: address to listen at; port: 0 for any free port"""
        self._newest: dict[type, str | bytes] = {}
        self._pages: set[_CameraViewer] = set()
        files = file_routes(resources.files(__package__), "page.html")
        super().__init__(host, port, [*files, web.get("/live", self._live)])

    def show(self, message: str | bytes) -> None:
        """Send a text, or a JPEG, to all pages."""
        self._newest[type(message)] = message
        for page in self._pages:
            page.show(message)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        page = _CameraViewer(self._newest)
        self._pages.add(page)
        try:
            return await self.serve_viewer(request, page)
        finally:
            self._pages.discard(page)


class _CameraViewer(Viewer):
    """One open page; a slow one misses texts and pictures."""

    def __init__(self, newest: dict[type, str | bytes]) -> None:
        super().__init__()
        self._messages = dict(newest)

    def show(self, message: str | bytes) -> None:
        """Send a message next; it replaces one of its kind that still waits."""
        self._messages[type(message)] = message
        self.wake()

    def take(self) -> Iterable[str | bytes]:
        """Return the messages that wait, and forget them."""
        messages, self._messages = self._messages, {}
        return messages.values()
