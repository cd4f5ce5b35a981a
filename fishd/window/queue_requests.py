"""Requests of a page about the queue of experiments of a fish."""

import asyncio
import time
from typing import Annotated, Any, Literal

from aiohttp import web
from msgspec import Meta, Struct

from fishd.core import text
from fishd.core.experiment_queue import MAX_ITEMS, QueueFile, Repeat, View
from fishd.window.access import AccessControl
from fishd.window.answers import ApiError
from fishd.window.children import call
from fishd.window.fish_link import FishLink
from fishd.window.job_options import QUEUE, list_words, swims
from fishd.window.job_requests import JobRequest, JobRequests
from fishd.window.pages import Pages


class QueueChange(Struct, forbid_unknown_fields=True):
    """Body of a change; each operation uses some of the arguments."""

    op: Literal["add", "move", "repeat", "remove", "pause", "stop", "cancel-pause", "clear"]
    kind: str = ""
    options: dict[str, Any] = {}
    """Options of the experiment to add."""
    repeat: Repeat = 1
    number: Annotated[int, Meta(ge=0, le=2**31)] = 0
    """Identifier of an experiment in the queue."""
    position: Annotated[int, Meta(ge=1, le=MAX_ITEMS)] = 1
    at: Annotated[float, Meta(ge=0, le=1e11)] | None = None
    """Unix time at which it pauses [s]; None for the end of the run that goes on."""

    def apply(self, file: QueueFile) -> None:
        """Change the queue; raise `QueueError`."""
        with file.changing() as queue:
            match self.op:
                case "move":
                    queue.move(self.number, self.position)
                case "repeat":
                    queue.find(self.number).repeat = self.repeat
                case "remove":
                    queue.remove(self.number)
                case "pause":
                    queue.pause(self.at)
                case "stop":
                    queue.pause(time.time())
                case "cancel-pause":
                    queue.cancel_pause()
                case "clear":
                    queue.clear()


class QueueRequests:
    """The requests about queues; a disk that stalls delays nothing else."""

    def __init__(self, access: AccessControl, pages: Pages, jobs: JobRequests) -> None:
        self._access, self._pages, self._jobs = access, pages, jobs
        self._adding = asyncio.Lock()
        self.routes = [
            access.get("/api/fish/{fish}/queue", self._show, jobs.waiting_for_disk),
            access.post(
                "/api/fish/{fish}/queue", self._change, QueueChange, waiting=jobs.waiting_for_disk
            ),
        ]

    async def _show(self, request: web.Request) -> View:
        link = self._pages.find_link(request.match_info["fish"])
        return await asyncio.to_thread(self._view, link)

    async def _change(self, request: web.Request, change: QueueChange) -> View:
        link = self._pages.find_link(request.match_info["fish"])
        if change.op == "add":
            words = await self._list_words(link, change)
            async with self._adding:  # one process at a time
                self._access.require(request, "drive")
                await call(words, self._jobs.folder)
        return await asyncio.to_thread(self._view, link, change)

    def _view(self, link: FishLink, change: QueueChange | None = None) -> View:
        """Return the queue of a fish, after a change if there is one; raise `QueueError`."""
        file = QueueFile(self._jobs.folder, link.endpoint)
        if change and change.op != "add":
            change.apply(file)
        return file.view()

    async def _list_words(self, link: FishLink, change: QueueChange) -> list[str]:
        """Return the arguments of fishctl that check an experiment and add it to the queue."""
        body = JobRequest(link.name, change.kind, change.options)
        form = None
        if change.kind not in ("resume", QUEUE.kind):
            form, _, options = await self._jobs.check_job(body)
        if form is None or not swims(form, options):
            raise ApiError(400, "unknown-kind", f"a queue takes no '{text.quoted(change.kind)}'")
        words, on = list_words(form, options), f"--on={options.on}"
        place = [f"--repeat={change.repeat}", *link.endpoint_options, "--json"]
        return ["queue", "add", *place, "--", *words, *([] if "--on" in words else [on])]
