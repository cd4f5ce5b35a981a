"""Pages that are open: the fish that they show, what they are sent, and which of them drives."""

import asyncio
import logging
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager
from typing import Any

import msgspec
from aiohttp import web

from fishd.core import text
from fishd.window.access import Access, AccessControl
from fishd.window.answers import ApiError
from fishd.window.devices import DeviceError
from fishd.window.fish_link import FishLink
from fishd.window.foxglove import FoxglovePage
from fishd.window.jobs import Job
from fishd.window.live import Driver, LivePage, encode, encode_message
from fishd.window.settings import UNNAMED_FISH
from fishd.window.viewer import Viewer

log = logging.getLogger(__name__)

WATCH_PERIOD_S = 0.2
"""Period of looking for revoked devices and for drivers that are gone [s]."""
CONNECTION_PERIOD_S = 1.0
"""Period of messages about a connection that is not live [s]."""


class Pages:
    """The open pages of all fish, and the links to these."""

    def __init__(
        self,
        endpoints: Mapping[str, str | None],
        access: AccessControl,
        list_jobs: Callable[[], list[Job]],
        list_viewers: Callable[[], Iterable[Viewer]],
        stop_jobs: Callable[[Set[str]], None],
    ) -> None:
        """
        endpoints: control socket of each fish, by its name
        list_jobs, list_viewers: return all jobs, and the open WebSockets of all kinds
        stop_jobs: ends those of devices without access; gets the identifiers of those with it
        """
        self.links = {
            name: FishLink(name, endpoint, self._teller(name))
            for name, endpoint in endpoints.items()
        }
        self._access, self._list_jobs, self._list_viewers = access, list_jobs, list_viewers
        self._stop_jobs = stop_jobs
        self._pages: set[LivePage] = set()
        self._session = secrets.token_hex(4)
        self._drivers: dict[str, Driver] = {}
        self._absent: dict[str, Driver] = {}
        """Driver of each fish that swims on without its page."""
        self._endings: set[asyncio.Task[None]] = set()
        """Ends of the role of drivers that are gone; fishd may be slow to answer."""

    @property
    def names(self) -> dict[str | None, str]:
        """Name of each fish by its control socket; empty for one fish that was given no name."""
        if list(self.links) == [UNNAMED_FISH]:
            return {}
        return {link.endpoint: name for name, link in self.links.items()}

    async def run(self) -> None:
        """Follow the fish, and watch over the pages, until this task is cancelled."""
        runs = (link.run() for link in self.links.values())
        await asyncio.gather(*runs, self._watch())

    async def close(self) -> None:
        """Return the fish."""
        for link in self.links.values():
            await link.close()

    def find_link(self, name: str) -> FishLink:
        """Return the link to a fish; raise `ApiError` if there is none of this name."""
        if name not in self.links:
            known = ", ".join(self.links)
            raise ApiError(404, "no-fish", f"no fish is named '{text.quoted(name)}'; here: {known}")
        return self.links[name]

    def find_page(self, request: web.Request, access: Access) -> LivePage:
        """Return the open page that sent a request; raise `ApiError` if there is none."""
        client = request.headers.get("X-Client", "")
        for page in self._pages:
            if (page.client, page.device_id) == (client, access.device_id):
                page.seen = time.monotonic()
                return page
        raise ApiError(
            409, "no-page", "this request is from no open page: the header X-Client is needed"
        )

    # Opening and closing

    @contextmanager
    def open_live(self, request: web.Request) -> Iterator[LivePage]:
        """Yield a new page, which gets messages within the context."""
        access = self._access.require(request, "watch")
        link = self.find_link(request.query.get("fish", next(iter(self.links))))
        page = LivePage(secrets.token_urlsafe(9), link.name, access.name, access.device_id)
        driver = self._drivers.get(link.name)
        resumed = driver and driver.page
        if (
            driver
            and resumed
            and resumed not in self._pages
            and (request.query.get("client"), access.device_id)
            == (resumed.client, resumed.device_id)
        ):
            page.client, driver.page = resumed.client, page
        link.flush()
        self._greet(page)
        self._pages.add(page)
        try:
            yield page
        finally:
            self._pages.discard(page)

    @contextmanager
    def open_foxglove(self, request: web.Request) -> Iterator[FoxglovePage]:
        """Yield a new viewer of Foxglove's protocol, which gets messages within the context."""
        access = self._access.find(request)
        if access.scope is None:
            raise web.HTTPUnauthorized(text="this device is not paired\n")
        link = self.find_link(request.query.get("fish", next(iter(self.links))))
        page = FoxglovePage(link.name, self._session, link.status.readings if link.status else {})
        page.device_id = access.device_id
        link.listeners.add(page.add)
        try:
            yield page
        finally:
            link.listeners.discard(page.add)

    # Messages

    def _teller(self, name: str) -> Callable[[str, bytes], None]:
        def tell(kind: str, payload: bytes) -> None:
            pages = [page for page in self._pages if page.fish == name]
            if not pages:
                return
            if kind == "hello":
                for page in pages:
                    try:
                        self._greet(page)
                    except DeviceError:  # it was revoked
                        page.end()
                return
            message = encode_message(kind, payload)
            for page in pages:
                page.push(kind, message)

        return tell

    def tell_job(self, job: Job) -> None:
        """Send a job that has changed to all pages."""
        message = encode_message("job", encode(job))
        for page in self._pages:
            page.push("job", message)

    def _greet(self, page: LivePage) -> None:
        """Send the first message to a page, the history, and the ticks that are not in it."""
        history, later = self.links[page.fish].history()
        page.push("hello", encode_message("hello", encode(self._hello(page))))
        for message in history:
            page.push("history", message)
        if later != b"[]":
            page.push("ticks", encode_message("ticks", later))

    def _hello(self, page: LivePage) -> dict[str, Any]:
        link, driver = self.links[page.fish], self._drivers.get(page.fish)
        return {
            "client": page.client,
            "fish": list(self.links),
            "name": link.name,
            "session": self._access.find_device(page.device_id).describe(),
            "status": link.status,
            "controllers": link.controllers,
            "events": [msgspec.Raw(event) for event in link.events],
            "jobs": self._list_jobs(),
            "connection": link.connection,
            "driver": driver and driver.describe_to(page),
            "you_drive": bool(driver and driver.page is page),
        }

    # Drivers

    def driver_of(self, name: str) -> Driver | None:
        """Return the driver of a fish."""
        return self._drivers.get(name)

    def set_driver(self, name: str, driver: Driver | None) -> None:
        """Let a page drive a fish, or none."""
        self._absent.pop(name, None)
        if driver:
            self._drivers[name] = driver
        else:
            self._drivers.pop(name, None)
        for page in self._pages:
            if page.fish == name:
                payload = encode(driver and driver.describe_to(page))
                page.push("driver", encode_message("driver", payload))

    def require_driver(self, name: str, page: LivePage) -> None:
        """Raise `ApiError` unless this page drives the fish."""
        driver = self._drivers.get(name)
        if driver is None or driver.page is not page:
            what = f"{driver.page.device} drives" if driver else "no page drives"
            raise ApiError(409, "not-driver", f"{what} {name}", "take over to drive it")

    async def end_driving(self, name: str, driver: Driver | None) -> None:
        """Let no page drive a fish, and return it unless its driver wanted otherwise.

        driver: the driver that ends; nothing changes if another page has taken over since
        """
        if self._drivers.get(name) is not driver:
            return
        self.set_driver(name, None)
        if driver and driver.keep:
            self._absent[name] = driver
        elif driver:
            await self._return(name)

    async def _return(self, name: str) -> None:
        """Let a fish come to rest, unless another page drives it by then."""
        await self.links[name].give_back(is_driven=lambda: name in self._drivers)

    async def _watch(self) -> None:
        """Close pages of revoked devices, and end the role of drivers that are gone."""
        next_connection, warned = 0.0, dict.fromkeys(self.links, False)
        while True:
            await asyncio.sleep(WATCH_PERIOD_S)
            self._endings = {ending for ending in self._endings if not ending.done()}
            self._access.refresh()
            self._close_revoked()
            for name, driver in list(self._drivers.items()):
                if driver.is_gone:
                    log.warning("%s has left while it drove %s", driver.page.device, name)
                    self._endings.add(asyncio.create_task(self.end_driving(name, driver)))
            is_due = time.monotonic() >= next_connection
            if is_due:
                next_connection = time.monotonic() + CONNECTION_PERIOD_S
            for name, link in self.links.items():
                warns = bool(link.connection.warning)
                is_bad = warns or link.connection.state in ("stale", "lost")
                if warns != warned[name] or (is_due and is_bad):
                    warned[name] = warns
                    self._teller(name)("connection", encode(link.connection))

    def _close_revoked(self) -> None:
        paired = self._access.paired_ids()
        for viewer in self._list_viewers():
            if viewer.device_id not in paired:
                viewer.end()
        for name, driver in [*self._drivers.items(), *self._absent.items()]:
            if driver.page.device_id not in paired:
                log.warning("%s drives %s and was revoked", driver.page.device, name)
                self.set_driver(name, None)
                self._endings.add(asyncio.create_task(self._return(name)))
        self._stop_jobs(paired)
