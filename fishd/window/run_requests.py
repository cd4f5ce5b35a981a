"""Requests of a page that change runs, compare and download them; fishctl carries them out."""

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Annotated

from aiohttp import web
from msgspec import Meta, Struct

from fishd.core import text
from fishd.core.schema import PRINTABLE
from fishd.window.access import AccessControl
from fishd.window.answers import ApiError, NoArguments, read_body, success
from fishd.window.downloads import ENDINGS, Downloads
from fishd.window.runs import Runs, check_name

MAX_COMPARED_RUNS = 12
_TRASH_ID = re.compile(r"\d{8}-\d{6}(-\d+)?", re.A)


class NewNote(Struct, forbid_unknown_fields=True):
    """Body of note."""

    note: Annotated[str, Meta(pattern=PRINTABLE, max_length=1000)]


class NewName(Struct, forbid_unknown_fields=True):
    """Body of rename."""

    name: Annotated[str, Meta(pattern=PRINTABLE, max_length=100)]


class RunRequests:
    """The requests about runs."""

    def __init__(
        self, access: AccessControl, runs: Runs, wait: Callable[[], AbstractContextManager[None]]
    ) -> None:
        """wait: counts a request that may wait for the disk, and raises `Busy` for one too many"""
        self._access, self._runs, self._wait = access, runs, wait
        self._downloads = Downloads(runs.folder, runs.scratch)
        self.routes = [
            web.get("/api/runs/{run}/download/{file}", self._download, allow_head=False),
            web.post("/api/runs/{run}/note", self._set_note),
            web.post("/api/runs/{run}/rename", self._rename),
            web.post("/api/runs/{run}/delete", self._delete),
            web.get("/api/results", self._show_results),
            web.get("/api/results.png", self._draw_results),
            web.get("/api/trash", self._list_trash),
            web.post("/api/trash/{id}/restore", self._restore),
        ]

    async def _download(self, request: web.Request) -> web.StreamResponse:
        access = self._access.require(request, "watch")
        file = request.match_info["file"]
        if file not in ENDINGS:
            message = f"no download '{text.quoted(file)}'; valid: {', '.join(ENDINGS)}"
            raise ApiError(404, "not-found", message)
        run = check_name(request.match_info["run"])
        return await self._downloads.send(request, run, file, access.device_id)

    async def _change(self, request: web.Request, verb: str, *words: str) -> web.Response:
        """Let a verb of `fishctl runs` change a run."""
        run = check_name(request.match_info["run"])
        with self._wait():
            return success(await self._runs.change(verb, run, *words))

    async def _set_note(self, request: web.Request) -> web.Response:
        self._access.require(request, "drive")
        return await self._change(request, "note", (await read_body(request, NewNote)).note)

    async def _rename(self, request: web.Request) -> web.Response:
        self._access.require(request, "drive")
        return await self._change(request, "rename", (await read_body(request, NewName)).name)

    async def _delete(self, request: web.Request) -> web.Response:
        self._access.require(request, "drive")
        await read_body(request, NoArguments)
        return await self._change(request, "delete")

    async def _list_trash(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch")
        with self._wait():
            return success(await self._runs.call_json("trash"))

    async def _restore(self, request: web.Request) -> web.Response:
        self._access.require(request, "drive")
        await read_body(request, NoArguments)
        deleted = request.match_info["id"]
        if not _TRASH_ID.fullmatch(deleted):
            raise ApiError(404, "not-found", f"the trash has no '{text.quoted(deleted)}'")
        with self._wait():
            return success(await self._runs.change("restore", deleted))

    def _list_compared(self, request: web.Request) -> list[str]:
        """Return the names of the runs in a query; raise `ApiError`, and `JobError`."""
        names = list(dict.fromkeys(request.query.getall("run", [])))
        if not 1 <= len(names) <= MAX_COMPARED_RUNS:
            message = f"{len(names)} runs; 1 to {MAX_COMPARED_RUNS} can be compared"
            raise ApiError(400, "bad-arguments", message)
        return [check_name(name) for name in names]

    async def _show_results(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch")
        names = self._list_compared(request)
        with self._wait():
            return success(await self._runs.call_json("show", *names))

    async def _draw_results(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch")
        names = self._list_compared(request)
        with self._wait():
            picture = await self._runs.plot_over_each_other(names)
        return web.Response(body=picture, content_type="image/png")
