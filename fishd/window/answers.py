"""Answers of the window's requests as JSON, and what is wrong with a request."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import msgspec
from aiohttp import web
from msgspec import Struct

from fishd.core import schema, text
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError, FishError, NoDaemon, ParameterError, Refused
from fishd.core.experiment_queue import QueueError
from fishd.window import web_server
from fishd.window.children import JobError
from fishd.window.devices import DeviceError, DevicesBusy
from fishd.window.fish_link import Busy
from fishd.window.live import encode

log = logging.getLogger(__name__)

T = TypeVar("T")
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class ApiError(FishdError):
    """A request that is refused."""

    def __init__(self, status: int, code: str, message: str, remedy: str = "") -> None:
        super().__init__(message)
        self.status, self.code, self.remedy = status, code, remedy


class NoArguments(Struct, forbid_unknown_fields=True):
    """Body of a request without arguments."""


async def read_body(
    request: web.Request, kind: type[T], seconds: float = web_server.REQUEST_TIMEOUT_S
) -> T:
    """Return the body of a request, which must come within this time [s]; raise `ApiError`."""
    if request.content_type != "application/json":
        raise ApiError(415, "bad-request", "Content-Type: application/json is needed")
    try:
        async with asyncio.timeout(seconds):
            body = await request.read()
    except TimeoutError:
        raise ApiError(408, "bad-request", "the body of the request has not come") from None
    try:
        data = decoder(Any)(body or b"{}")
    except msgspec.DecodeError as error:
        raise ApiError(400, "bad-request", f"not JSON: {text.error_message(error)}") from None
    return convert(data, kind)


def convert(data: Any, kind: type[T], prefix: str = "") -> T:
    """Return data as a struct; raise `ApiError`, whose message begins with `prefix`."""
    try:
        return schema.convert(data, kind)
    except schema.Problem as problem:
        message = str(problem).replace(" (or null)", "")
        where = "".join(f"{text.quoted(name)}: " for name in problem.path)
        raise ApiError(400, "bad-arguments", f"{prefix}{where}{text.line(message)}") from None


def success(result: Any) -> web.Response:
    """Return the answer to a request that was carried out."""
    body = encode({"ok": True, "result": result})
    return web.Response(body=body, content_type="application/json")


@web.middleware
async def answer_in_json(request: web.Request, handler: Handler) -> web.StreamResponse:
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
    except OSError as error:
        refusal = ApiError(503, "system", text.describe_error(error))
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


_REFUSALS = (
    (NoDaemon, 503, "no-daemon"),
    ((Busy, DevicesBusy), 503, "busy"),
    ((JobError, QueueError), 409, "job"),
    (DeviceError, 403, "device"),
    (ParameterError, 400, "bad-arguments"),
    (FishError, 503, "no-daemon"),
    (FishdError, 500, "failed"),
)
"""Status and code of each kind of error; the first one that fits counts."""


def _refusal(error: FishdError) -> ApiError:
    """Return an error of fishd or of the window with its status."""
    message = text.error_message(error)
    if isinstance(error, ApiError):
        return error
    if isinstance(error, Refused):
        return ApiError(409, text.quoted(error.code), message)
    status, code = next(kind[1:] for kind in _REFUSALS if isinstance(error, kind[0]))
    return ApiError(status, code, message)
