"""Access to the window: the device of a request, what it may do, and the pairing of devices.

A request from the network needs a paired device; an emergency stop is open to each of them.
"""

import logging
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Annotated, Any, NamedTuple, TypeVar

from aiohttp import web
from msgspec import Meta, Struct

from fishd import __version__
from fishd.window.answers import ApiError, NoArguments, read_body, success
from fishd.window.devices import Device, Scope
from fishd.window.paired_devices import PairedDevices
from fishd.window.places import is_loopback as is_loopback_address
from fishd.window.web_server import check_body, host_name

log = logging.getLogger(__name__)
T = TypeVar("T")
Waiting = Callable[[], AbstractContextManager[None]]
"""Function that counts a request that may wait, and raises `Busy` for one too many."""

COOKIE = "fishd_window"
COOKIE_S = 365 * 86400
"""Time for which a browser keeps its cookie [s]."""
MAX_PAIRING_BYTES = 512
"""Largest size of a request of a device that may not be paired [bytes]."""
PAIRING_TIMEOUT_S = 1.0
"""Longest time until the body of such a request has come [s]."""
FORWARDED = ("Forwarded", "X-Forwarded-For", "X-Forwarded-Host", "X-Real-IP", "Via")
"""Headers by which a reverse proxy shows that the browser is elsewhere."""


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

    def describe(self) -> dict[str, Any]:
        """Return the permissions as a page gets them."""
        return {
            "paired": self.scope is not None,
            "scope": self.scope,
            "device": self.name if self.scope else None,
            "loopback": self.loopback,
            "version": __version__,
        }


class Pairing(Struct, forbid_unknown_fields=True):
    """Body of pair."""

    token: Annotated[str, Meta(max_length=200)]
    name: Annotated[str, Meta(max_length=1000)] = ""


class AccessControl:
    """The permissions of each request, and the requests that pair a device."""

    def __init__(self, devices: PairedDevices, pair_all: bool) -> None:
        """pair_all: whether browsers on this machine need pairing, too"""
        self._devices, self._pair_all = devices, pair_all
        self.routes = [
            web.get("/api/session", self._get_session),
            web.post("/api/pair", self._pair),
            web.post("/api/unpair", self._unpair),
        ]

    def find(self, request: web.Request, takes_bearer: bool = False) -> Access:
        """Return the permissions of a request, as `require` does."""
        token = takes_bearer and _read_bearer(request)
        device = self._devices.find(token or request.cookies.get(COOKIE))
        loopback = not self._pair_all and is_loopback(request)
        scope: Scope | None = "drive" if loopback else device.scope if device else None
        return Access(scope, None if loopback else device, loopback)

    def find_device(self, device_id: str) -> Access:
        """Return the permissions of a device; raise `DeviceError` if it is not paired."""
        if not device_id:
            return Access("drive", None, True)
        device = self._devices.get(device_id)
        return Access(device.scope, device, False)

    def paired_ids(self) -> set[str]:
        """Return the identifiers of all devices that have access."""
        return {device.id for device in self._devices.all()} | {""}

    def require(self, request: web.Request, scope: Scope, *, takes_bearer: bool = False) -> Access:
        """Return the permissions of a request; raise `ApiError` if they do not suffice.

        takes_bearer: whether a program may send its token in the header Authorization
        """
        if request.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            raise ApiError(403, "other-origin", "this request is from a page of another site")
        access = self.find(request, takes_bearer)
        if access.scope is None:
            raise ApiError(
                401,
                "not-paired",
                "this device is not paired",
                "run 'fishctl window token NAME' on the fish's computer, and send what it prints "
                "as 'Authorization: Bearer TOKEN'"
                if takes_bearer
                else "run 'fishctl window pair' on the fish's computer, and open the link here",
            )
        if scope == "drive" and access.scope != "drive":
            raise ApiError(
                403,
                "only-watch",
                "this device may only watch",
                "pair it again with 'fishctl window pair --scope drive'",
            )
        return access

    def get(
        self,
        path: str,
        handle: Callable[[web.Request], Awaitable[Any]],
        waiting: Waiting = nullcontext,
    ) -> web.RouteDef:
        """Return the route of a request for devices that may watch.

        handle: returns the answer, or what is sent in it as JSON
        """

        async def serve(request: web.Request) -> web.StreamResponse:
            request["access"] = self.require(request, "watch")
            with waiting():
                result = await handle(request)
            return result if isinstance(result, web.StreamResponse) else success(result)

        return web.get(path, serve)

    def post(
        self,
        path: str,
        handle: Callable[[web.Request, T], Awaitable[Any]],
        kind: type[T],
        scope: Scope = "drive",
        waiting: Waiting = nullcontext,
    ) -> web.RouteDef:
        """Return the route of a request with a body of this kind, for devices of this scope."""

        async def serve(request: web.Request) -> web.StreamResponse:
            request["access"] = self.require(request, scope)
            body = await read_body(request, kind)
            with waiting():
                return success(await handle(request, body))

        return web.post(path, serve)

    def is_paired(self, request: web.Request) -> bool:
        """Return whether a request is from a paired device."""
        return self._devices.find(request.cookies.get(COOKIE)) is not None

    def refresh(self) -> None:
        """Read the paired devices soon if they have changed."""
        self._devices.refresh()

    async def _get_session(self, request: web.Request) -> web.Response:
        return success(self.find(request).describe())

    async def _pair(self, request: web.Request) -> web.Response:
        pairing = await _read_small_body(request, Pairing)
        device, secret = await self._devices.pair(pairing.token, pairing.name)
        log.info("%s is paired, to %s", device.name, device.scope)
        response = success(Access(device.scope, device, False).describe())
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
        await _read_small_body(request, NoArguments)
        if device := self._devices.find(request.cookies.get(COOKIE)):
            await self._devices.revoke(device.id)
        response = success(None)
        response.del_cookie(COOKIE, path="/", httponly=True, samesite="Strict")
        return response


def is_loopback(request: web.Request) -> bool:
    """Return whether a request is from a browser of this machine, and not through a proxy."""
    name = host_name(request.host)
    if any(header in request.headers for header in FORWARDED):
        return False
    is_name_local = name == "localhost" or is_loopback_address(name)
    return is_name_local and is_loopback_address(request.remote or "")


def _read_bearer(request: web.Request) -> str:
    """Return the token in the header Authorization; empty if there is none."""
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


async def _read_small_body(request: web.Request, kind: type[T]) -> T:
    """Return the body of a request that needs no pairing; raise `ApiError`."""
    check_body(request, MAX_PAIRING_BYTES)
    return await read_body(request, kind, PAIRING_TIMEOUT_S)
