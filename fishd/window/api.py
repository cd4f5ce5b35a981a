"""Requests of the page, and what its WebSocket is sent.

A request from the network needs a paired device. Only the page that drives changes how a fish
swims; an emergency stop is open to each paired device.
"""

import asyncio
import logging
import secrets
import time
from collections.abc import Awaitable, Callable
from importlib import resources
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from aiohttp import web
from msgspec import Meta, Struct

from fishd import __version__
from fishd.core import text
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError, NoDaemon, ParameterError, Refused
from fishd.window import web_server
from fishd.window.devices import Device, DeviceError, Devices, Scope
from fishd.window.fish_link import Busy, FishLink
from fishd.window.foxglove import PROTOCOL, FoxglovePage
from fishd.window.jobs import DRIVING_KINDS, KINDS, Job, JobError, Jobs
from fishd.window.live import Driver, LivePage, encode, encode_message
from fishd.window.settings import WindowSettings
from fishd.window.web_server import WebServer, file_routes, host_name, parse_ip

log = logging.getLogger(__name__)

COOKIE = "fishd_window"
COOKIE_S = 365 * 86400
MAX_BODY_BYTES = 16 * 2**10
WATCH_PERIOD_S = 0.2
"""Period of looking for revoked devices and for drivers that are gone [s]."""
CONNECTION_PERIOD_S = 1.0
"""Period of messages about a connection that is not live [s]."""
FORWARDED = ("Forwarded", "X-Forwarded-For", "X-Forwarded-Host", "X-Real-IP", "Via")
"""Headers by which a reverse proxy shows that the browser is elsewhere."""

T = TypeVar("T")
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
Text = Annotated[str, Meta(max_length=1000)]


class ApiError(FishdError):
    """A request that is refused."""

    def __init__(self, status: int, code: str, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.status, self.code, self.remedy = status, code, remedy


class Access(NamedTuple):
    """Permissions of the sender of a request."""

    scope: Scope | None
    """None for a device that is not paired."""
    device: Device | None
    """None for a browser on this machine, which needs no pairing, and without a scope."""
    loopback: bool

    @property
    def name(self) -> str:
        """Name of the device."""
        return self.device.name if self.device else "this machine"

    @property
    def device_id(self) -> str:
        """Identifier of the device; empty for a browser on this machine."""
        return self.device.id if self.device else ""


class Pairing(Struct, forbid_unknown_fields=True):
    """Body of pair."""

    token: Annotated[str, Meta(max_length=200)]
    name: Text = ""


class Drive(Struct, forbid_unknown_fields=True):
    """Body of drive."""

    take: bool = False
    keep: bool = False


class FishRequest(Struct, forbid_unknown_fields=True):
    """Body of request."""

    op: str
    args: dict[str, Any] = {}
    take: bool = False


class JobRequest(Struct, forbid_unknown_fields=True):
    """Body of a job."""

    fish: str
    kind: str
    options: dict[str, Any] = {}


class _NoArguments(Struct, forbid_unknown_fields=True):
    pass


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
    "stop": _NoArguments,
    "clear-fault": _NoArguments,
    "mark": _Mark,
    "tare": _Tare,
}
"""Arguments of the operations of a request, by name."""


class Window(WebServer):
    """Server of the page; an asynchronous context manager in one event loop."""

    def __init__(self, settings: WindowSettings) -> None:
        """Raises `DeviceError` where the state folder cannot be used."""
        self.devices = Devices(settings.state_folder)
        self._links = {
            name: FishLink(name, endpoint, self._teller(name))
            for name, endpoint in settings.endpoints.items()
        }
        self._pair_all = settings.pair_all
        self._jobs = Jobs(settings.runs_folder, self._tell_job)
        self._pages: set[LivePage] = set()
        self._session = secrets.token_hex(4)
        self._drivers: dict[str, Driver] = {}
        self._endings: set[asyncio.Task[None]] = set()
        """Ends of the role of drivers that are gone; fishd may be slow to answer."""
        self._tasks: list[asyncio.Task[None]] = []
        host, port = settings.address
        routes = [
            *file_routes(resources.files(__package__).joinpath("page"), "index.html"),
            web.get("/live", self._live),
            web.get("/foxglove", self._serve_foxglove),
            web.get("/api/session", self._get_session),
            web.post("/api/pair", self._pair),
            web.post("/api/unpair", self._unpair),
            web.get("/api/fish", self._list_fish),
            web.post("/api/fish/{fish}/estop", self._estop),
            web.post("/api/fish/{fish}/drive", self._drive),
            web.post("/api/fish/{fish}/release", self._release),
            web.post("/api/fish/{fish}/request", self._request),
            web.get("/api/fish/{fish}/history", self._get_history),
            web.get("/api/jobs", self._list_jobs),
            web.post("/api/jobs", self._start_job),
            web.post("/api/jobs/{job}/stop", self._stop_job),
            web.get("/api/runs", self._list_runs),
            web.get("/api/runs/{run}/plot.png", self._plot_run),
        ]
        super().__init__(
            host,
            port,
            routes,
            names=settings.names,
            middlewares=[_answer_in_json],
            readers={"/foxglove": frozenset(settings.origins)},
            max_body_bytes=MAX_BODY_BYTES,
            advice="name another one with --listen",
        )

    async def __aenter__(self) -> "Window":
        """Listen, and follow the fish; raises `StartupError`."""
        await super().__aenter__()
        runs = [link.run() for link in self._links.values()]
        self._tasks = [asyncio.create_task(run) for run in (*runs, self._watch())]
        return self

    async def __aexit__(self, *details: object) -> None:
        """Return the fish, and close all pages."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._jobs.close()
        for link in self._links.values():
            await link.close()
        await super().__aexit__(*details)

    # Pages

    def _teller(self, name: str) -> Callable[[str, bytes], None]:
        def tell(kind: str, payload: bytes) -> None:
            pages = [page for page in self._pages if page.fish == name]
            if not pages:
                return
            if kind == "hello":
                for page in pages:
                    try:
                        self._greet(page)
                    except DeviceError:  # it was revoked, or the file is damaged
                        page.end()
                return
            message = encode_message(kind, payload)
            for page in pages:
                page.push(kind, message)

        return tell

    async def _live(self, request: web.Request) -> web.StreamResponse:
        access = self._require(request, "watch")
        link = self._link(request.query.get("fish", next(iter(self._links))))
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
            return await self.serve_viewer(request, page)
        finally:
            self._pages.discard(page)

    async def _serve_foxglove(self, request: web.Request) -> web.StreamResponse:
        access = self._access(request)
        if access.scope is None:
            raise web.HTTPUnauthorized(text="this device is not paired\n")
        link = self._link(request.query.get("fish", next(iter(self._links))))
        page = FoxglovePage(link.name, self._session)
        page.device_id = access.device_id
        link.listeners.add(page.add)
        try:
            return await self.serve_viewer(request, page, [PROTOCOL])
        finally:
            link.listeners.discard(page.add)

    def _greet(self, page: LivePage) -> None:
        """Send the first message to a page, and the ticks that are not in its history."""
        history, later = self._links[page.fish].history()
        page.push("hello", encode_message("hello", encode(self._hello(page, history))))
        if later != b"[]":
            page.push("ticks", encode_message("ticks", later))

    def _hello(self, page: LivePage, history: bytes) -> dict[str, Any]:
        link, driver = self._links[page.fish], self._drivers.get(page.fish)
        return {
            "client": page.client,
            "fish": list(self._links),
            "name": link.name,
            "session": self._describe_session(self._access_of(page)),
            "history": msgspec.Raw(history),
            "status": link.status,
            "controllers": link.controllers,
            "events": [msgspec.Raw(event) for event in link.events],
            "jobs": self._jobs.all(),
            "connection": link.connection,
            "driver": driver and driver.describe_to(page),
            "you_drive": bool(driver and driver.page is page),
        }

    def _access_of(self, page: LivePage) -> Access:
        if not page.device_id:
            return Access("drive", None, True)
        device = self.devices.get(page.device_id)
        return Access(device.scope, device, False)

    async def _watch(self) -> None:
        """Close pages of revoked devices, and end the role of drivers that are gone."""
        next_connection = 0.0
        while True:
            await asyncio.sleep(WATCH_PERIOD_S)
            self._endings = {ending for ending in self._endings if not ending.done()}
            try:
                self._close_revoked()
            except FishdError as error:
                log.error("%s", error)
            for name, driver in list(self._drivers.items()):
                if driver.is_gone:
                    log.warning("%s has left while it drove %s", driver.page.device, name)
                    self._endings.add(asyncio.create_task(self._end_driving(name)))
            if time.monotonic() >= next_connection:
                next_connection = time.monotonic() + CONNECTION_PERIOD_S
                for name, link in self._links.items():
                    if link.connection.state in ("stale", "lost"):
                        self._teller(name)("connection", encode(link.connection))

    def _close_revoked(self) -> None:
        paired = {device.id for device in self.devices.all()} | {""}
        for viewer in self.viewers:
            if viewer.device_id not in paired:
                viewer.end()
        for name, driver in list(self._drivers.items()):
            if driver.page.device_id not in paired:
                driver.page.seen = -1e9
                log.warning("%s drives %s and was revoked", driver.page.device, name)

    # Session and devices

    def _access(self, request: web.Request) -> Access:
        device = self.devices.find(request.cookies.get(COOKIE))
        loopback = not self._pair_all and is_loopback(request)
        scope: Scope | None = "drive" if loopback else device.scope if device else None
        return Access(scope, None if loopback else device, loopback)

    def _require(self, request: web.Request, scope: Scope) -> Access:
        if request.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            raise ApiError(403, "other-origin", "this request is from a page of another site")
        access = self._access(request)
        if access.scope is None:
            raise ApiError(
                401,
                "not-paired",
                "this device is not paired",
                "run 'fishctl window pair' on the fish's computer, and open the link here",
            )
        if scope == "drive" and access.scope != "drive":
            raise ApiError(
                403,
                "only-watch",
                "this device may only watch",
                "pair it again with 'fishctl window pair --scope drive'",
            )
        return access

    def _describe_session(self, access: Access) -> dict[str, Any]:
        return {
            "paired": access.scope is not None,
            "scope": access.scope,
            "device": access.name if access.scope else None,
            "loopback": access.loopback,
            "version": __version__,
        }

    async def _get_session(self, request: web.Request) -> web.Response:
        return _success(self._describe_session(self._access(request)))

    async def _pair(self, request: web.Request) -> web.Response:
        pairing = await _read_body(request, Pairing)
        device, secret = self.devices.pair(pairing.token, pairing.name)
        log.info("%s is paired, to %s", device.name, device.scope)
        access = Access(device.scope, device, False)
        response = _success(self._describe_session(access))
        response.set_cookie(
            COOKIE,
            secret,
            max_age=COOKIE_S,
            path="/",
            httponly=True,
            samesite="Strict",
            secure=request.headers.get("Origin", "").startswith("https:"),
        )
        return response

    async def _unpair(self, request: web.Request) -> web.Response:
        await _read_body(request, _NoArguments)
        if device := self.devices.find(request.cookies.get(COOKIE)):
            self.devices.revoke(device.id)
        response = _success(None)
        response.del_cookie(COOKIE, path="/", httponly=True, samesite="Strict")
        return response

    # Fish

    def _link(self, name: str) -> FishLink:
        if name not in self._links:
            known = ", ".join(self._links)
            raise ApiError(404, "no-fish", f"no fish is named '{text.quoted(name)}'; here: {known}")
        return self._links[name]

    def _page(self, request: web.Request, access: Access) -> LivePage:
        """Return the open page that sent a request."""
        client = request.headers.get("X-Client", "")
        for page in self._pages:
            if (page.client, page.device_id) == (client, access.device_id):
                page.seen = time.monotonic()
                return page
        raise ApiError(
            409, "no-page", "this request is from no open page: the header X-Client is needed"
        )

    async def _list_fish(self, request: web.Request) -> web.Response:
        self._require(request, "watch")
        return _success(
            [
                {"name": link.name, "endpoint": link.address, "state": link.connection.state}
                for link in self._links.values()
            ]
        )

    async def _estop(self, request: web.Request) -> web.Response:
        access = self._require(request, "watch")
        link = self._link(request.match_info["fish"])
        result = await link.estop(f"requested in the window by {access.name}")
        log.warning("emergency stop of %s by %s: %s", link.name, access.name, result["outcome"])
        return _success(result)

    async def _drive(self, request: web.Request) -> web.Response:
        access = self._require(request, "drive")
        link, body = self._link(request.match_info["fish"]), await _read_body(request, Drive)
        page = self._page(request, access)
        driver = self._drivers.get(link.name)
        if driver and driver.page is not page and not body.take:
            raise ApiError(
                409, "driven", f"{driver.page.device} drives {link.name}", "take over to drive it"
            )
        self._set_driver(link.name, Driver(page, body.keep))
        return _success({"driver": self._drivers[link.name].describe_to(page)})

    async def _release(self, request: web.Request) -> web.Response:
        access = self._require(request, "drive")
        link = self._link(request.match_info["fish"])
        await _read_body(request, _NoArguments)
        self._require_driver(link, self._page(request, access))
        await self._end_driving(link.name)
        return _success({"driver": None})

    def _set_driver(self, name: str, driver: Driver | None) -> None:
        if driver:
            self._drivers[name] = driver
        else:
            self._drivers.pop(name, None)
        for page in self._pages:
            if page.fish == name:
                payload = encode(driver and driver.describe_to(page))
                page.push("driver", encode_message("driver", payload))

    async def _end_driving(self, name: str) -> None:
        driver = self._drivers.get(name)
        self._set_driver(name, None)
        if driver and not driver.keep:
            await self._links[name].give_back()

    def _require_driver(self, link: FishLink, page: LivePage) -> Driver:
        driver = self._drivers.get(link.name)
        if driver is None or driver.page is not page:
            what = f"{driver.page.device} drives" if driver else "no page drives"
            raise ApiError(409, "not-driver", f"{what} {link.name}", "take over to drive it")
        return driver

    async def _request(self, request: web.Request) -> web.Response:
        access = self._require(request, "drive")
        link, body = self._link(request.match_info["fish"]), await _read_body(request, FishRequest)
        page = self._page(request, access)
        kind = OPERATIONS.get(body.op)
        if kind is None:
            known = ", ".join(OPERATIONS)
            raise ApiError(
                400, "unknown-op", f"no such op '{text.quoted(body.op)}'; valid: {known}"
            )
        arguments = msgspec.structs.asdict(_convert(body.args, kind, f"{body.op}: "))
        if body.op != "stop":
            self._require_driver(link, page)
        elif link.name not in self._drivers:
            self._set_driver(link.name, Driver(page, False))
        holder = f"window: {access.name}"
        return _success(await link.request(body.op, arguments, holder, body.take))

    async def _get_history(self, request: web.Request) -> web.Response:
        self._require(request, "watch")
        since = request.query.get("since", "0")
        if not (since.isascii() and since.isdigit() and len(since) < 16):
            raise ApiError(400, "bad-request", "since: the number of a tick is needed")
        return _success(self._link(request.match_info["fish"]).columns(int(since)))

    # Jobs and runs

    def _tell_job(self, job: Job) -> None:
        message = encode_message("job", encode(job))
        for page in self._pages:
            page.push("job", message)

    async def _list_jobs(self, request: web.Request) -> web.Response:
        self._require(request, "watch")
        return _success(self._jobs.all())

    async def _start_job(self, request: web.Request) -> web.Response:
        access = self._require(request, "drive")
        body = await _read_body(request, JobRequest)
        link, page = self._link(body.fish), self._page(request, access)
        if body.kind not in KINDS:
            message = f"no such kind '{text.quoted(body.kind)}'; valid: {', '.join(KINDS)}"
            raise ApiError(400, "unknown-kind", message)
        options = _convert(body.options, KINDS[body.kind], f"{body.kind}: ")
        if body.kind in DRIVING_KINDS:
            self._require_driver(link, page)
            await link.give_back()  # the experiment takes the fish itself
        job = self._jobs.start(body.kind, link.name, link.endpoint_options, options)
        self._tell_job(job)
        return _success(job)

    async def _stop_job(self, request: web.Request) -> web.Response:
        self._require(request, "drive")
        await _read_body(request, _NoArguments)
        return _success(self._jobs.stop(request.match_info["job"]))

    async def _list_runs(self, request: web.Request) -> web.Response:
        self._require(request, "watch")
        return _success(await self._jobs.list_runs())

    async def _plot_run(self, request: web.Request) -> web.Response:
        self._require(request, "watch")
        picture = await self._jobs.plot(request.match_info["run"])
        return web.Response(body=picture, content_type="image/png")


def is_loopback(request: web.Request) -> bool:
    """Return whether a request is from a browser of this machine, and not through a proxy."""
    name = host_name(request.host)
    if any(header in request.headers for header in FORWARDED):
        return False
    return _is_loopback(request.remote or "") and (name == "localhost" or _is_loopback(name))


def _is_loopback(name: str) -> bool:
    address = parse_ip(name)
    mapped = getattr(address, "ipv4_mapped", None)
    return address is not None and (mapped or address).is_loopback


async def _read_body(request: web.Request, kind: type[T]) -> T:
    """Return the body of a request; raise `ApiError`."""
    if request.content_type != "application/json":
        raise ApiError(415, "bad-request", "Content-Type: application/json is needed")
    try:
        async with asyncio.timeout(web_server.REQUEST_TIMEOUT_S):
            body = await request.read()
    except TimeoutError:
        raise ApiError(408, "bad-request", "the body of the request has not come") from None
    try:
        data = decoder(Any)(body or b"{}")
    except msgspec.DecodeError as error:
        raise ApiError(400, "bad-request", f"not JSON: {text.error_message(error)}") from None
    return _convert(data, kind)


def _convert(data: Any, kind: type[T], prefix: str = "") -> T:
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        message = f"{prefix}{text.error_message(error)}"
        raise ApiError(400, "bad-arguments", message) from None


def _success(result: Any) -> web.Response:
    body = encode({"ok": True, "result": result})
    return web.Response(body=body, content_type="application/json")


@web.middleware
async def _answer_in_json(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Answer errors of requests below /api/ as JSON, others as text."""
    headers: Any = {}
    try:
        return await handler(request)
    except web.HTTPException as error:
        if not request.path.startswith("/api/"):
            raise
        refusal = ApiError(error.status, error.reason.lower().replace(" ", "-"), error.text or "")
        headers = error.headers
    except FishdError as error:
        refusal = _refusal(error)
    except ConnectionError:  # the page has gone
        raise
    except Exception as error:
        log.error("%s failed: %s", request.path, text.describe_error(error), exc_info=True)
        refusal = ApiError(500, "internal", f"a mistake in fishd: {text.describe_error(error)}")
    failure = {"code": refusal.code, "message": str(refusal).strip(), "remedy": refusal.remedy}
    response = web.Response(
        status=refusal.status,
        body=encode({"ok": False, "error": failure}),
        content_type="application/json",
    )
    web_server.finish(response)
    if "Allow" in headers:
        response.headers["Allow"] = headers["Allow"]
    return response


def _refusal(error: FishdError) -> ApiError:
    """Return an error of fishd or of the window with its status."""
    message = text.error_message(error)
    if isinstance(error, ApiError):
        return error
    if isinstance(error, Refused):
        return ApiError(409, text.quoted(error.code), message)
    if isinstance(error, NoDaemon):
        return ApiError(503, "no-daemon", message)
    if isinstance(error, Busy):
        return ApiError(503, "busy", message)
    if isinstance(error, JobError):
        return ApiError(409, "job", message)
    if isinstance(error, DeviceError):
        return ApiError(403, "device", message)
    if isinstance(error, ParameterError):
        return ApiError(400, "bad-arguments", message)
    return ApiError(500, "failed", message)
