"""Requests of a page for experiments, and for the runs that they leave."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

from aiohttp import web
from msgspec import Struct

from fishd.core import text
from fishd.core.errors import ParameterError
from fishd.core.signals import ControllerInfo
from fishd.core.swim_plan import plan
from fishd.window.access import AccessControl
from fishd.window.answers import ApiError, NoArguments, convert, read_body, success
from fishd.window.fish_link import Busy, FishLink
from fishd.window.job_options import DRIVING_KINDS, KINDS, MEASURED_KINDS, list_words
from fishd.window.jobs import Jobs
from fishd.window.pages import Pages
from fishd.window.run_requests import RunRequests

MAX_WAITING_REQUESTS = 16
"""Number of requests that wait for the disk of runs above which a further one is refused."""


class JobRequest(Struct, forbid_unknown_fields=True):
    """Body of a job."""

    fish: str
    kind: str
    options: dict[str, Any] = {}


class JobRequests:
    """The requests about jobs and runs."""

    def __init__(self, access: AccessControl, pages: Pages, jobs: Jobs) -> None:
        self._access, self._pages, self._jobs = access, pages, jobs
        self._waiting = 0
        self.folder = jobs.runs.folder
        """Folder of recordings and experiments."""
        self.routes = [
            web.get("/api/jobs", self._list_jobs),
            web.post("/api/jobs", self._start_job),
            web.post("/api/jobs/check", self._check_job),
            web.post("/api/jobs/{job}/stop", self._stop_job),
            web.post("/api/jobs/{job}/dismiss", self._dismiss_job),
            web.get("/api/runs", self._list_runs),
            web.get("/api/runs/{run}/plot.png", self._plot_run),
            *RunRequests(access, jobs.runs, self.waiting_for_disk).routes,
        ]

    @contextmanager
    def waiting_for_disk(self) -> Iterator[None]:
        """Count a request that may wait for the disk of runs; raise `Busy` for one too many."""
        if self._waiting >= MAX_WAITING_REQUESTS:
            raise Busy(f"{self._waiting} requests wait for the disk of the runs; try again later")
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1

    async def _list_jobs(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch")
        return success(self._jobs.all())

    async def _read_job(self, request: web.Request) -> tuple[JobRequest, FishLink, Any]:
        """Return the job that a page wants, its fish, and its options; raise `ApiError`."""
        body = await read_body(request, JobRequest)
        return body, *self.check_job(body)

    def check_job(self, body: JobRequest) -> tuple[FishLink, Any]:
        """Return the fish of a job, and its options; raise `ApiError`."""
        link = self._pages.find_link(body.fish)
        if body.kind not in KINDS:
            message = f"no such kind '{text.quoted(body.kind)}'; valid: {', '.join(KINDS)}"
            raise ApiError(400, "unknown-kind", message)
        options = convert(body.options, KINDS[body.kind], f"{body.kind}: ")
        if getattr(options, "parameters", None):
            _check_parameters(options, link.controllers)
        if body.kind in MEASURED_KINDS:
            _check_length(options)
        return link, options

    async def _check_job(self, request: web.Request) -> web.Response:
        """Answer with the command line of a job, and what is wrong with it; start nothing."""
        self._access.require(request, "watch")
        try:
            body, _, options = await self._read_job(request)
        except ApiError as error:
            return success({"command": [], "problem": str(error)})
        words = [body.kind] if body.kind == "resume" else list_words(body.kind, options)
        return success({"command": ["fishctl", *words], "problem": ""})

    async def _start_job(self, request: web.Request) -> web.Response:
        access = self._access.require(request, "drive")
        body, link, options = await self._read_job(request)
        page = self._pages.find_page(request, access)

        def check() -> None:
            self._access.require(request, "drive")
            if body.kind in DRIVING_KINDS:
                self._pages.require_driver(link.name, page)

        check()
        if body.kind in DRIVING_KINDS:
            await link.give_back()  # the experiment takes the fish itself
        endpoint, device = link.endpoint_options, access.device_id
        with self.waiting_for_disk():
            job = await self._jobs.start(body.kind, link.name, endpoint, options, device, check)
        self._pages.tell_job(job)
        return success(job)

    async def _stop_job(self, request: web.Request) -> web.Response:
        self._access.require(request, "drive")
        await read_body(request, NoArguments)
        return success(self._jobs.stop(request.match_info["job"]))

    async def _dismiss_job(self, request: web.Request) -> web.Response:
        self._access.require(request, "drive")
        await read_body(request, NoArguments)
        job = self._jobs.dismiss(request.match_info["job"])
        self._pages.tell_job(job)
        return success(job)

    async def _list_runs(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch")
        with self.waiting_for_disk():
            return success(await self._jobs.runs.list_all())

    async def _plot_run(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch")
        with self.waiting_for_disk():
            picture = await self._jobs.runs.plot(request.match_info["run"])
        return web.Response(body=picture, content_type="image/png")


def _check_length(options: Any) -> None:
    """Raise `ApiError` if the time is too short or too long for a measurement."""
    try:
        plan(options.seconds, getattr(options, "parameters", {}))
    except ParameterError as error:
        raise ApiError(400, "bad-arguments", str(error)) from None


def _check_parameters(options: Any, controllers: Collection[ControllerInfo]) -> None:
    """Raise `ApiError` unless each name is that of a parameter, and so no other option."""
    if not controllers:
        raise ApiError(503, "no-daemon", "fishd has not answered yet, so no controller is known")
    names = {
        field.name
        for info in controllers
        if info.name == getattr(options, "controller", None)
        for field in info.parameters
    }
    for name in options.parameters:
        if name not in names:
            message = f"{options.controller} has no parameter '{text.quoted(name)}'"
            raise ApiError(400, "bad-arguments", message)
