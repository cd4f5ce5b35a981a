"""Requests of a page for experiments, and for the runs that they leave."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from aiohttp import web
from msgspec import Struct

from fishd.core import text
from fishd.core.errors import ParameterError
from fishd.core.experiments import Form, Plan
from fishd.window.access import Access, AccessControl
from fishd.window.answers import ApiError, NoArguments, convert
from fishd.window.children import JobError
from fishd.window.fish_link import Busy, FishLink
from fishd.window.job_options import (
    QUEUE,
    QueueOptions,
    ResumeOptions,
    check_parameters,
    list_words,
    swims,
)
from fishd.window.jobs import Job, Jobs
from fishd.window.pages import Pages
from fishd.window.run_requests import RunRequests

MAX_WAITING_REQUESTS = 16
"""Number of requests that wait for the disk of runs above which a further one is refused."""


class JobRequest(Struct, forbid_unknown_fields=True):
    """Body of a job."""

    fish: str
    kind: str
    options: dict[str, Any] = {}


class WantedJob(NamedTuple):
    """Job that a page wants, with checked options."""

    form: Form | None
    """None for an experiment that is resumed."""
    link: FishLink
    options: Any


class JobRequests:
    """The requests about jobs and runs."""

    def __init__(self, access: AccessControl, pages: Pages, jobs: Jobs) -> None:
        self._access, self._pages, self._jobs = access, pages, jobs
        self._waiting = 0
        self.folder = jobs.runs.folder
        """Folder of recordings and experiments."""
        self.routes = [
            access.get("/api/forms", self._list_forms),
            access.get("/api/jobs", self._list_jobs),
            access.post("/api/jobs", self._start_job, JobRequest),
            access.post("/api/jobs/check", self._check_job, JobRequest, scope="watch"),
            access.post("/api/jobs/{job}/stop", self._stop_job, NoArguments),
            access.post("/api/jobs/{job}/dismiss", self._dismiss_job, NoArguments),
            access.get("/api/runs", self._list_runs, self.waiting_for_disk),
            access.get("/api/runs/{run}/plot.png", self._plot_run, self.waiting_for_disk),
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

    async def _list_jobs(self, _: web.Request) -> list[Job]:
        return self._jobs.all()

    async def _list_forms(self, _: web.Request) -> list[Form]:
        return [form for form, _ in (await self._jobs.forms.all()).values()]

    async def _list_runs(self, _: web.Request) -> list[dict[str, Any]]:
        """Return all runs, those of a fish without a name with that of its control socket."""
        runs: list[dict[str, Any]] = await self._jobs.runs.list_all()
        for run in runs:
            words = run.get("command") or []
            for endpoint, name in self._pages.names.items():
                if run.get("on") == "live" and endpoint in words:
                    run["about"].setdefault("subject", name)
        return runs

    async def check_job(self, body: JobRequest) -> WantedJob:
        """Return a job with checked options; raise `ApiError` and `JobError`."""
        link = self._pages.find_link(body.fish)
        if body.kind == "resume":
            return WantedJob(None, link, convert(body.options, ResumeOptions, "resume: "))
        if body.kind == QUEUE.kind:
            return WantedJob(QUEUE, link, convert(body.options, QueueOptions, "queue: "))
        forms = await self._jobs.forms.all()
        if body.kind not in forms:
            message = f"no such kind '{text.quoted(body.kind)}'; valid: {', '.join(forms)}, resume"
            raise ApiError(400, "unknown-kind", message)
        form, kind = forms[body.kind]
        options: Any = convert(body.options, kind, f"{body.kind}: ")
        if body.kind == "record" and not options.subject:
            options.subject = self._pages.names.get(link.endpoint)
        if getattr(options, "parameters", None):
            if not link.controllers:
                message = "fishd has not answered yet, so no controller is known"
                raise ApiError(503, "no-daemon", message)
            check_parameters(options, link.controllers)
        return WantedJob(form, link, options)

    async def _plan(self, job: WantedJob) -> Plan | None:
        """Return what an experiment is going to do; raise `ApiError` if it cannot."""
        if job.form is None:
            return None
        try:
            with self.waiting_for_disk():
                return await self._jobs.forms.plan(job.form, job.options, job.link.endpoint_options)
        except JobError as error:
            raise ApiError(400, "bad-arguments", str(error)) from None

    async def _check_job(self, request: web.Request, body: JobRequest) -> dict[str, Any]:
        """Return the command line of a job, its plan, and what is wrong with it."""
        try:
            job = await self.check_job(body)
            plan = await self._plan(job) if request["access"].scope == "drive" else None
        except (ApiError, JobError, ParameterError) as error:
            return {"command": [], "problem": str(error), "plan": None}
        words = list_words(job.form, job.options) if job.form else ["resume"]
        return {"command": ["fishctl", *words], "problem": "", "plan": plan}

    async def _start_job(self, request: web.Request, body: JobRequest) -> Job:
        access: Access = request["access"]
        form, link, options = wanted = await self.check_job(body)
        page = self._pages.find_page(request, access)
        with self.waiting_for_disk():
            drives = await self._drives(wanted)

        def check() -> None:
            self._access.require(request, "drive")
            if drives:
                self._pages.require_driver(link.name, page)

        check()
        plan = await self._plan(wanted)
        check()
        if drives:
            await link.give_back()  # the experiment takes the fish itself
        endpoint, device = link.endpoint_options, access.device_id
        with self.waiting_for_disk():
            job = await self._jobs.start(form, link.name, endpoint, options, device, check, plan)
        self._pages.tell_job(job)
        return job

    async def _drives(self, job: WantedJob) -> bool:
        """Return whether a job swims the live fish."""
        if job.form is QUEUE:
            return True
        if job.form:
            return swims(job.form, job.options) and job.options.on == "live"
        header = await asyncio.to_thread(self._jobs.runs.read_header, job.options.run)
        return header is None or header.on == "live"

    async def _stop_job(self, request: web.Request, _: NoArguments) -> Job:
        return self._jobs.stop(request.match_info["job"])

    async def _dismiss_job(self, request: web.Request, _: NoArguments) -> Job:
        job = self._jobs.dismiss(request.match_info["job"])
        self._pages.tell_job(job)
        return job

    async def _plot_run(self, request: web.Request) -> web.Response:
        picture = await self._jobs.runs.plot(request.match_info["run"])
        return web.Response(body=picture, content_type="image/png")
