"""Requests of a page that change runs, compare and download them; fishctl carries them out."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

from aiohttp import web
from msgspec import Meta, Struct

from fishd.core import text
from fishd.core.schema import PRINTABLE
from fishd.window.access import AccessControl, Waiting
from fishd.window.answers import ApiError, NoArguments
from fishd.window.downloads import ENDINGS, Downloads
from fishd.window.runs import Runs, check_name

MAX_COMPARED_RUNS = 12


class NewNote(Struct, forbid_unknown_fields=True):
    """Body of note."""

    note: Annotated[str, Meta(pattern=PRINTABLE, max_length=1000)]


class NewName(Struct, forbid_unknown_fields=True):
    """Body of rename."""

    name: Annotated[str, Meta(pattern=PRINTABLE, max_length=100)]


class DeletedRuns(Struct, forbid_unknown_fields=True):
    """Body of empty: what the user saw in the trash, as another device may delete a run since."""

    ids: Annotated[list[str], Meta(min_length=1)]


class RunRequests:
    """The requests about runs."""

    def __init__(self, access: AccessControl, runs: Runs, waiting: Waiting) -> None:
        self._access, self._runs = access, runs
        self._downloads = Downloads(runs.folder, runs.scratch)

        def change(verb: str, read: Callable[[Any], tuple[str, ...]], kind: type) -> web.RouteDef:
            """Return the route of a verb of `fishctl runs`; read: its arguments in the body."""

            async def handle(request: web.Request, body: Any) -> Any:
                return await runs.change(verb, check_name(request.match_info["run"]), *read(body))

            return access.post(f"/api/runs/{{run}}/{verb}", handle, kind, waiting=waiting)

        self.routes = [
            web.get("/api/runs/{run}/download/{file}", self._download, allow_head=False),
            change("note", lambda body: (body.note,), NewNote),
            change("rename", lambda body: (body.name,), NewName),
            change("delete", lambda body: (), NoArguments),
            access.get("/api/results", self._show_results, waiting),
            access.get("/api/results.png", self._draw_results, waiting),
            access.get("/api/trash", lambda _: runs.call_verb("trash"), waiting),
            access.post("/api/trash/{id}/restore", self._restore, NoArguments, waiting=waiting),
            access.post("/api/trash/empty", self._empty_trash, DeletedRuns, waiting=waiting),
        ]

    async def _download(self, request: web.Request) -> web.StreamResponse:
        access = self._access.require(request, "watch")
        file = request.match_info["file"]
        if file not in ENDINGS:
            message = f"no download '{text.quoted(file)}'; valid: {', '.join(ENDINGS)}"
            raise ApiError(404, "not-found", message)
        run, device = check_name(request.match_info["run"]), access.device_id
        check = partial(self._access.require, request, "watch")
        return await self._downloads.send(request, run, file, device, check)

    async def _restore(self, request: web.Request, _: NoArguments) -> Any:
        return await self._runs.change("restore", check_name(request.match_info["id"]))

    async def _empty_trash(self, _: web.Request, body: DeletedRuns) -> Any:
        return await self._runs.call_verb("trash", *map(check_name, body.ids), options=["--empty"])

    async def _show_results(self, request: web.Request) -> Any:
        return await self._runs.call_verb("show", *_list_compared(request))

    async def _draw_results(self, request: web.Request) -> web.Response:
        picture = await self._runs.plot_over_each_other(_list_compared(request))
        return web.Response(body=picture, content_type="image/png")


def _list_compared(request: web.Request) -> list[str]:
    """Return the names of the runs in a query; raise `ApiError`, and `JobError`."""
    names = list(dict.fromkeys(request.query.getall("run", [])))
    if not 1 <= len(names) <= MAX_COMPARED_RUNS:
        message = f"{len(names)} runs; 1 to {MAX_COMPARED_RUNS} can be compared"
        raise ApiError(400, "bad-arguments", message)
    return [check_name(name) for name in names]
