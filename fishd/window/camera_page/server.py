"""Server of the page of the camera: three files, and a WebSocket that sends pictures and facts.

No request changes anything.
"""

from collections.abc import Iterable
from importlib import resources

from aiohttp import web

from fishd.window.camera_page.feed import News
from fishd.window.viewer import Viewer
from fishd.window.web_server import WebServer, file_routes


class PageServer(WebServer):
    """Server of the page of one camera; an asynchronous context manager in one event loop."""

    def __init__(self, host: str, port: int) -> None:
        """host: address to listen at; port: 0 for any free port"""
        self._news = News(b"{}", None)
        self._pages: set[_CameraViewer] = set()
        files = file_routes(resources.files(__package__), "page.html")
        super().__init__(host, port, [*files, web.get("/live", self._live)])

    def show(self, news: News) -> None:
        """Send an update to all pages."""
        self._news = News(news.facts, self._news.jpeg if news.jpeg is None else news.jpeg)
        for page in self._pages:
            page.show(news)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        page = _CameraViewer(self._news)
        self._pages.add(page)
        try:
            return await self.serve_viewer(request, page)
        finally:
            self._pages.discard(page)


class _CameraViewer(Viewer):
    """One open page; a slow one misses updates."""

    def __init__(self, first: News) -> None:
        super().__init__()
        self._news: News | None = first

    def show(self, news: News) -> None:
        """Send an update next; it replaces one that still waits, but not the picture by none."""
        if news.jpeg is None and self._news is not None:
            news = News(news.facts, self._news.jpeg)
        self._news = news
        self.wake()

    def take(self) -> Iterable[bytes]:
        """Return the newest update, if it was not sent."""
        news, self._news = self._news, None
        return [] if news is None else [_encode_news(news)]


def _encode_news(news: News) -> bytes:
    """Return an update as one message: length of the facts, the facts, and the JPEG."""
    return len(news.facts).to_bytes(4, "big") + news.facts + (news.jpeg or b"")
