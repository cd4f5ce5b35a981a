"""Requests of a page to a fish: drive it, change how it swims, stop it.

Only the page that drives changes how a fish swims.
"""

import logging
from functools import partial
from typing import Annotated, Any

import msgspec
from aiohttp import web
from msgspec import Meta, Struct

from fishd.core import text
from fishd.core.protocol import PolicyInfo
from fishd.window.access import Access, AccessControl
from fishd.window.answers import ApiError, NoArguments, convert, success
from fishd.window.live import Driver
from fishd.window.pages import Pages
from fishd.window.web_server import ESTOP

log = logging.getLogger(__name__)

Text = Annotated[str, Meta(max_length=1000)]


class Drive(Struct, forbid_unknown_fields=True):
    """Body of drive."""

    take: bool = False
    keep: bool = False


class FishRequest(Struct, forbid_unknown_fields=True):
    """Body of request."""

    op: str
    args: dict[str, Any] = {}
    take: bool = False


class _SetController(Struct, forbid_unknown_fields=True):
    name: Text
    parameters: dict[str, Any] = {}


class _SetParameters(Struct, forbid_unknown_fields=True):
    parameters: dict[str, Any]


class _Mark(Struct, forbid_unknown_fields=True):
    text: Text


class _Tare(Struct, forbid_unknown_fields=True):
    seconds: Annotated[float, Meta(ge=0.1, le=60)] = 2.0


OPERATIONS: dict[str, type[Struct]] = {
    "set-controller": _SetController,
    "set-parameters": _SetParameters,
    "stop": NoArguments,
    "clear-fault": NoArguments,
    "restart": NoArguments,
    "mark": _Mark,
    "tare": _Tare,
}
"""Arguments of the operations of a request, by name."""


class FishRequests:
    """The requests about one fish each."""

    def __init__(self, access: AccessControl, pages: Pages) -> None:
        self._access, self._pages = access, pages
        self.routes = [
            access.get("/api/fish", self._list_fish),
            access.get("/api/fish/{fish}/policies", self._list_policies),
            web.post("/api/fish/{fish}/estop", self._estop, name=ESTOP),
            access.post("/api/fish/{fish}/drive", self._drive, Drive),
            access.post("/api/fish/{fish}/release", self._release, NoArguments),
            access.post("/api/fish/{fish}/request", self._request, FishRequest),
        ]

    async def _list_fish(self, _: web.Request) -> list[dict[str, str]]:
        return [
            {"name": link.name, "endpoint": link.address, "state": link.connection.state}
            for link in self._pages.links.values()
        ]

    async def _list_policies(self, request: web.Request) -> list[PolicyInfo]:
        return await self._pages.find_link(request.match_info["fish"]).list_policies()

    async def _estop(self, request: web.Request) -> web.Response:
        access = self._access.require(request, "watch")
        link = self._pages.find_link(request.match_info["fish"])
        result = await link.estop_path.stop(f"requested in the window by {access.name}")
        log.warning("emergency stop of %s by %s: %s", link.name, access.name, result["outcome"])
        return success(result)

    async def _drive(self, request: web.Request, body: Drive) -> dict[str, Any]:
        link = self._pages.find_link(request.match_info["fish"])
        page = self._pages.find_page(request, request["access"])
        driver = self._pages.driver_of(link.name)
        if driver and driver.page is not page and not body.take:
            raise ApiError(
                409, "driven", f"{driver.page.device} drives {link.name}", "take over to drive it"
            )
        driver = Driver(page, body.keep)
        self._pages.set_driver(link.name, driver)
        return {"driver": driver.describe_to(page)}

    async def _release(self, request: web.Request, _: NoArguments) -> dict[str, None]:
        link = self._pages.find_link(request.match_info["fish"])
        self._pages.require_driver(link.name, self._pages.find_page(request, request["access"]))
        await self._pages.end_driving(link.name, self._pages.driver_of(link.name))
        return {"driver": None}

    async def _request(self, request: web.Request, body: FishRequest) -> dict[str, Any]:
        access: Access = request["access"]
        link = self._pages.find_link(request.match_info["fish"])
        page = self._pages.find_page(request, access)
        kind = OPERATIONS.get(body.op)
        if kind is None:
            known = ", ".join(OPERATIONS)
            raise ApiError(
                400, "unknown-op", f"no such op '{text.quoted(body.op)}'; valid: {known}"
            )
        arguments = msgspec.structs.asdict(convert(body.args, kind, f"{body.op}: "))
        check = partial(self._pages.require_driver, link.name, page)
        if body.op != "stop":
            check()
        elif self._pages.driver_of(link.name) is None:
            self._pages.set_driver(link.name, Driver(page, False))
        holder = f"window: {access.name}"
        return await link.request(body.op, arguments, holder, body.take, check)
