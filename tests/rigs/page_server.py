"""Server of the files of the page, and of a WebSocket that sends texts and pictures."""

from importlib import resources

from aiohttp import web

from fishd.window.camera_feed import CameraViewer, Picture
from fishd.window.web_server import WebServer, file_routes


class PageServer(WebServer):
    """Server of one page; an asynchronous context manager in one event loop."""

    def __init__(self, host: str, port: int) -> None:
        self._newest: dict[type, str | Picture] = {}
        self._pages: set[CameraViewer] = set()
        files = file_routes(resources.files("fishd.window").joinpath("page"), "index.html")
        super().__init__(host, port, [*files, web.get("/live", self._live)])

    def show(self, message: str | Picture) -> None:
        """Send a text or a picture to all pages."""
        self._newest[type(message)] = message
        for page in self._pages:
            page.show(message)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        page = CameraViewer("")
        for message in self._newest.values():
            page.show(message)
        self._pages.add(page)
        try:
            return await self.serve_viewer(request, page)
        finally:
            self._pages.discard(page)
