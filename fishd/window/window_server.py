"""Server of the page of the fish: its files, its WebSockets, and its requests."""

import asyncio
import logging
from contextlib import AsyncExitStack
from importlib import resources
from typing import Self
from urllib.parse import urlsplit

from aiohttp import web

from fishd.core import text
from fishd.window.access import AccessControl
from fishd.window.answers import ApiError, answer_in_json
from fishd.window.camera_feed import CameraFeed
from fishd.window.fish_requests import FishRequests
from fishd.window.foxglove import PROTOCOLS
from fishd.window.inspection import InspectionRequests
from fishd.window.job_requests import JobRequests
from fishd.window.jobs import Jobs
from fishd.window.metrics import MetricsRequests
from fishd.window.pages import Pages
from fishd.window.paired_devices import PairedDevices
from fishd.window.queue_requests import QueueRequests
from fishd.window.register import Register, RunningWindow, remove_killed
from fishd.window.settings import WindowSettings
from fishd.window.web_server import WebServer, file_routes

log = logging.getLogger(__name__)

MAX_BODY_BYTES = 16 * 2**10


class WindowServer(WebServer):
    """Server of the page; an asynchronous context manager in one event loop."""

    def __init__(self, settings: WindowSettings) -> None:
        """Raises `DeviceError` where the state folder cannot be used."""
        access = AccessControl(PairedDevices(settings.state_folder), settings.pair_all)
        self._access = access
        self._settings, self._register = settings, Register(settings.state_folder)
        self._jobs = Jobs(
            settings.runs_folder,
            self._register.scratch,
            tell=lambda job: self._pages.tell_job(job),
            show_folder=settings.runs is not None,
        )
        self._pages = Pages(
            settings.endpoints,
            access,
            self._jobs.all,
            lambda: self.viewers,
            self._jobs.stop_without_access,
        )
        self._cameras = {
            name: CameraFeed(address, self._pages.links[name])
            for name, address in settings.camera_addresses.items()
        }
        job_requests = JobRequests(access, self._pages, self._jobs)
        host, port = settings.address
        routes = [
            *file_routes(resources.files(__package__).joinpath("page"), "index.html"),
            web.get("/live", self._serve_live),
            web.get("/foxglove", self._serve_foxglove),
            web.get("/camera", self._serve_camera),
            *access.routes,
            *FishRequests(access, self._pages).routes,
            *job_requests.routes,
            *QueueRequests(access, self._pages, job_requests).routes,
            *InspectionRequests(
                access, self._pages, self._jobs.runs, settings.camera_addresses
            ).routes,
            *MetricsRequests(access, self._pages.links, settings.runs_folder).routes,
        ]
        super().__init__(
            host,
            port,
            routes,
            names=settings.names,
            middlewares=[answer_in_json],
            readers={"/foxglove": frozenset(settings.origins)},
            is_paired=access.is_paired,
            max_body_bytes=MAX_BODY_BYTES,
        )

    async def __aenter__(self) -> Self:
        """Listen, and follow the fish; raises `StartupError`."""
        async with AsyncExitStack() as stack:
            stack.enter_context(self._register)
            await super().__aenter__()
            remove_killed(self._settings.state_folder)
            host = self._settings.listen.rpartition(":")[0]
            listen = f"{host}:{urlsplit(self.url).port}"
            entry = RunningWindow(listen, self._settings.names)
            await asyncio.to_thread(self._register.write, entry)
            self._run = asyncio.create_task(self._pages.run())
            self._run.add_done_callback(_log_failure)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *details: object) -> None:
        """Return the fish, and close all pages."""
        async with self._stack:
            self._run.cancel()
            await asyncio.gather(self._run, return_exceptions=True)
            await self._jobs.close()
            await self._pages.close()
            await super().__aexit__(*details)

    async def _serve_live(self, request: web.Request) -> web.StreamResponse:
        with self._pages.open_live(request) as page:
            return await self.serve_viewer(request, page)

    async def _serve_camera(self, request: web.Request) -> web.StreamResponse:
        access = self._access.require(request, "watch")
        name = self._pages.find_link(request.query.get("fish", next(iter(self._pages.links)))).name
        if name not in self._cameras:
            raise ApiError(404, "no-camera", f"no camera is above {name}", "add it to 'cameras'")
        with self._cameras[name].open(access.device_id) as viewer:
            return await self.serve_viewer(request, viewer)

    async def _serve_foxglove(self, request: web.Request) -> web.StreamResponse:
        with self._pages.open_foxglove(request) as page:
            return await self.serve_viewer(request, page, PROTOCOLS)


def _log_failure(run: asyncio.Task[None]) -> None:
    if not run.cancelled() and (error := run.exception()):
        log.critical(
            "pages no longer follow the fish, and revocation has no effect: %s; restart it",
            text.describe_error(error),
        )
