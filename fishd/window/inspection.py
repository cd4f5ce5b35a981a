"""Requests about a fish and its computer: versions, disk, settings, calibrations, log and checks.

Nothing is changed. Requests for the same thing share one answer, so that many cost as much as one.
"""

import asyncio
import platform
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Callable, Coroutine, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from aiohttp import web

from fishd import __version__
from fishd.core import text
from fishd.core.addresses import SERVICE_SOCKET
from fishd.core.clock import read_boot_id
from fishd.core.errors import FishError
from fishd.window.access import AccessControl
from fishd.window.answers import ApiError, NoArguments
from fishd.window.children import JobError, call_json
from fishd.window.fish_link import FishLink
from fishd.window.metrics import measure_disk
from fishd.window.pages import Pages
from fishd.window.runs import Runs

UNIT = "fishd.service"
LOG_LINES = 200
MAX_LOG_BYTES = 200_000
ANSWER_TIMEOUT_S = 15.0
"""Longest wait of a request for its answer; the next one waits for the same answer [s]."""
RATED_RECORDINGS = 5
"""Number of latest recordings from which the bytes of an hour are computed."""
MIN_RATED_S = 60.0
"""Shortest recording from which they are computed [s]."""
BYTES_PER_TICK = 280.0
"""Mean size of a tick in a recording, where there is none to compute it from [bytes]."""
CAMERA_TIMEOUT_S = 1.0
"""Longest wait for the state of a camera [s]."""

Row = dict[str, Any]


class InspectionRequests:
    """The requests that look at a fish and its computer."""

    def __init__(
        self,
        access: AccessControl,
        pages: Pages,
        runs: Runs,
        cameras: Mapping[str, str | None],
    ) -> None:
        """cameras: address of the requests of the camera above each fish, by its name"""
        self._pages, self._runs, self._cameras = pages, runs, cameras
        self._answers: dict[tuple[str, str], asyncio.Task[Any]] = {}
        """Latest answer about each fish and part; it may still be awaited."""
        self._defaults: Row = {}
        self._parts: dict[str, Callable[[FishLink], Coroutine[Any, Any, Any]]] = {
            "computer": lambda link: asyncio.to_thread(_describe_computer, link),
            "disk": self._read_disk,
            "settings": self._read_settings,
            "camera": self._read_camera,
            "log": _read_log,
        }
        self.routes = [
            access.get("/api/fish/{fish}/about/{part}", self._get_part),
            access.post("/api/fish/{fish}/doctor", self._examine, NoArguments, scope="watch"),
        ]

    async def _get_part(self, request: web.Request) -> Any:
        link, part = self._pages.find_link(request.match_info["fish"]), request.match_info["part"]
        if part not in self._parts:
            known = ", ".join(self._parts)
            raise ApiError(404, "no-part", f"no such part '{text.quoted(part)}'; here: {known}")
        return await self._answer(link, part, self._parts[part])

    async def _examine(self, request: web.Request, _: NoArguments) -> Any:
        link = self._pages.find_link(request.match_info["fish"])
        return await self._answer(link, "doctor", self._run_doctor)

    async def _answer(
        self, link: FishLink, part: str, read: Callable[[FishLink], Coroutine[Any, Any, Any]]
    ) -> Any:
        """Return what `read` returns, which runs once at a time; raise `ApiError`."""
        task = self._answers.get((link.name, part))
        if task is None or task.done():
            task = self._answers[link.name, part] = asyncio.create_task(read(link))
        try:
            return await asyncio.wait_for(asyncio.shield(task), ANSWER_TIMEOUT_S)
        except TimeoutError:
            message = f"{part}: no answer within {ANSWER_TIMEOUT_S:g} s; try again later"
            raise ApiError(503, "busy", message) from None

    async def _run_doctor(self, link: FishLink) -> Any:
        """Return the results of `fishctl doctor --json`; raise `JobError`."""
        words = ["doctor", "--json", *link.endpoint_options]
        return await call_json(words, self._runs.folder)

    async def _read_disk(self, link: FishLink) -> Row:
        """Return the free space for recordings [bytes], and the bytes of an hour."""
        disk = await asyncio.to_thread(measure_disk, self._runs.folder)
        recordings: list[Any] = []
        with suppress(JobError):
            recordings = await self._runs.list_all()
        rate, count = await asyncio.to_thread(_measure_rate, recordings)
        period = link.status.tick if link.status else 0.05
        return {
            "folder": str(self._runs.folder),
            "free": disk and disk.free,
            "size": disk and disk.size,
            "hourly": rate or BYTES_PER_TICK * 3600.0 / period,
            "recordings": count,
        }

    async def _read_settings(self, link: FishLink) -> Row:
        """Return the keys of the configuration, and the calibrations; raise `FishdError`."""
        if not self._defaults:
            words = ["config", "show", "--json"]
            self._defaults = dict(_flatten(await call_json(words, self._runs.folder)))
        settings, calibrations = await link.read_settings()
        missing = object()
        keys = [
            {
                "key": key,
                "value": value,
                "default": self._defaults.get(key),
                "differs": self._defaults.get(key, missing) != value,
            }
            for key, value in _flatten(settings)
        ]
        return {"keys": keys, "calibrations": list(_list_calibrations(calibrations))}

    async def _read_camera(self, link: FishLink) -> list[Row]:
        """Return what the camera above a fish has learned; nothing without a camera."""
        if link.name not in self._cameras:
            return []
        return await asyncio.to_thread(_list_learned, self._cameras[link.name])


def _describe_computer(link: FishLink) -> Row:
    """Return versions, and whether systemd starts fishd again."""
    status = link.status
    rows = [("page", f"fishd-window {__version__}"), ("Python", platform.python_version())]
    with suppress(OSError):
        rows.append(("system", platform.freedesktop_os_release().get("PRETTY_NAME", "Linux")))
    rows += [("kernel", platform.release()), ("computer", _read_model())]
    if status:
        where = "" if status.boot_id == read_boot_id() else ", on another computer than the page"
        rows.insert(0, ("fish", f"fishd {status.version}, robot {status.robot}{where}"))
    return {
        "rows": [{"name": name, "value": value} for name, value in rows],
        "is_service": _is_service(link),
    }


def _read_model() -> str:
    try:
        return Path("/proc/device-tree/model").read_text(errors="replace").rstrip("\0\n")
    except OSError:
        return platform.machine()


def _is_service(link: FishLink) -> bool:
    """Return whether a fish is that of the service of systemd."""
    is_systemd = Path("/run/systemd/system").is_dir()
    return is_systemd and link.address == f"ipc://{SERVICE_SOCKET}"


async def _read_log(link: FishLink) -> Row:
    """Return the latest lines of fishd's journal, or why there are none."""
    if not _is_service(link):
        return {"lines": [], "problem": "fishd is not the service of this computer; see its events"}
    command = f"journalctl --unit={UNIT} --lines={LOG_LINES}"
    options = ("--output=short-iso", "--no-hostname", "--no-pager", "--quiet")
    lines = list[str]()
    try:
        journal = await asyncio.create_subprocess_exec(
            *command.split(), *options, stdin=DEVNULL, stdout=PIPE, stderr=PIPE
        )
        output, errors = await journal.communicate()
        lines = output[-MAX_LOG_BYTES:].decode("utf-8", "replace").splitlines()[-LOG_LINES:]
        reason = text.line(errors.decode("utf-8", "replace"))
    except OSError as error:
        reason = f"journalctl: {text.describe_error(error)}"
    problem = f"{reason or 'the journal has no line that the page may read'}; run: sudo {command}"
    return {"lines": lines, "problem": "" if lines else problem}


def _measure_rate(recordings: list[Any]) -> tuple[float, int]:
    """Return the bytes of an hour in the latest recordings, and their number; 0 without one."""
    size, seconds, count = 0, 0.0, 0
    for run in reversed(recordings):
        if run.get("state") == "finished" and run.get("duration", 0.0) >= MIN_RATED_S:
            with suppress(OSError):
                size += Path(run["path"]).stat().st_size
                seconds += run["duration"]
                count += 1
        if count == RATED_RECORDINGS:
            break
    return (size / seconds * 3600.0 if count else 0.0), count


def _flatten(settings: Row, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each key of a configuration, with its sections before dots, and its value."""
    for key, value in settings.items():
        if isinstance(value, dict) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _list_calibrations(calibrations: Any) -> Iterator[Row]:
    """Yield the calibrations of fishd with their dates; nothing for a robot without them."""
    if calibrations is None:
        return
    force, servo = calibrations.force, calibrations.servo
    error = force.thrust_ci95(1.0)
    known = "its error is unknown" if error is None else f"a thrust is known to ± {error:.2%}"
    unset = "forces are in volts: run fishctl calibrate force"
    trial = "on trial" if calibrations.on_trial else ""
    own = "that of the configuration: run fishctl calibrate servo"
    yield {"what": "zero of the force", "date": force.tare_date, "note": ""}
    yield {"what": "force", "date": force.date, "note": unset if force.is_unset else known}
    yield {"what": "servo", "date": servo.date, "note": trial if servo.date or trial else own}


def _list_learned(address: str | None) -> list[Row]:
    """Return what a camera has learned of the tail; nothing if no camera answers."""
    from fishd.camera.requests import CameraRequests, find_camera

    with suppress(FishError), CameraRequests(address or find_camera(), CAMERA_TIMEOUT_S) as camera:
        state = camera.status(CAMERA_TIMEOUT_S)
        error = state.tail_zero_ci95
        known = "" if error is None else f"its zero is known to ± {error * 1e3:.1f} mrad"
        unlearned = "run fishctl camera measure --learn"
        note = known if state.tail_learned else state.tail_problem or unlearned
        return [{"what": "tail in the camera", "date": state.tail_learned, "note": note}]
    return []
