"""Downloads of runs: files, and what fishctl makes of them, sent piece by piece.

A browser that stops reading loses its download; few are sent at a time.
"""

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from aiohttp import web

from fishd.core import text
from fishd.core.errors import FishdError
from fishd.core.files import FileProblem
from fishd.window.children import JobError, spawn
from fishd.window.exports import exported
from fishd.window.fish_link import Busy
from fishd.window.pictures import open_entry
from fishd.window.web_server import finish

MAX_DOWNLOADS = 4
"""Largest number of downloads at a time."""
MAX_DOWNLOADS_PER_DEVICE = 2
PIECE_BYTES = 2**16
STALL_TIMEOUT_S = 30.0
"""Longest time that a browser may take to read a piece [s]."""
ENDINGS = {
    "recording.mcap": ".mcap",
    "ticks.csv": ".csv",
    "events.csv": "-events.csv",
    "ticks.parquet": ".parquet",
    "rows.csv": "-rows.csv",
    "all.zip": ".zip",
}
"""Ending that a downloaded file adds to the name of its run, by the name of the download."""

Read = Callable[[], Awaitable[bytes]]
"""Function that returns the next piece of a download; empty at its end."""


class Downloads:
    """Downloads of the runs of a folder; use it in one event loop."""

    def __init__(self, folder: Path, scratch: Path) -> None:
        """scratch: folder for tables until they are sent"""
        self._folder, self._scratch = folder, scratch
        self._devices: list[str] = []
        """Identifier of the device of each download at present."""

    async def send(
        self,
        request: web.Request,
        run: str,
        file: str,
        device: str,
        check: Callable[[], object],
    ) -> web.StreamResponse:
        """Send a download to a device; raise `JobError`, and `Busy` for one too many.

        run: name of the file or folder of a run; file: one of `ENDINGS`
        check: raises `FishdError` if the device may no longer get it
        """
        name = _file_name(run, file)
        with self._place_of(device):
            try:
                async with self._open(run, file) as read:
                    return await _send(request, read, name, check)
            except FileProblem as problem:
                raise JobError(str(problem)) from None

    @contextmanager
    def _place_of(self, device: str) -> Iterator[None]:
        own = self._devices.count(device)
        if len(self._devices) >= MAX_DOWNLOADS or own >= MAX_DOWNLOADS_PER_DEVICE:
            count = len(self._devices)
            raise Busy(f"{count} downloads are being sent, {own} of them here; wait for an end")
        self._devices.append(device)
        try:
            yield
        finally:
            self._devices.remove(device)

    @asynccontextmanager
    async def _open(self, run: str, file: str) -> AsyncIterator[Read]:
        if file == "all.zip":
            async with _packed(run, self._folder) as read:
                yield read
            return
        if file in ("recording.mcap", "rows.csv"):
            opened = await asyncio.to_thread(self._open_file, run, file)
        else:
            opened = await self._export(run, file)
        try:
            yield lambda: asyncio.to_thread(opened.read, PIECE_BYTES)
        finally:
            opened.close()

    def _open_file(self, run: str, file: str) -> BinaryIO:
        """Return a recording, or a file in the folder of an experiment, open.

        Raise `FileProblem`, also for a link.
        """
        if file == "recording.mcap":
            return os.fdopen(open_entry(self._folder / run, f"'{run}'"), "rb")
        place = open_entry(self._folder / run, f"'{run}'", os.O_DIRECTORY)
        try:
            return os.fdopen(open_entry(Path(file), f"'{run}/{file}'", folder=place), "rb")
        finally:
            os.close(place)

    async def _export(self, run: str, file: str) -> BinaryIO:
        """Return a table of a recording, open, and removed already; raise `JobError`."""
        recording = await asyncio.to_thread(self._open_file, run, "recording.mcap")
        recording.close()
        path, form = self._folder / run, file.rpartition(".")[2]
        async with exported(path, form, self._scratch, self._folder) as place:
            return await asyncio.to_thread((place / _file_name(run, file)).open, "rb")


def _file_name(run: str, file: str) -> str:
    """Return the name of a download for the browser."""
    return run.removesuffix(".part").removesuffix(".mcap") + ENDINGS[file]


@asynccontextmanager
async def _packed(run: str, folder: Path) -> AsyncIterator[Read]:
    """Provide the zip file of a run while fishctl packs it."""
    words = ["runs", "zip", f"--folder={folder}", "--to=-", "--", run]
    process = await spawn(words, folder)
    assert process.stdout
    assert process.stderr
    output, errors = process.stdout, process.stderr

    async def read() -> bytes:
        if piece := await output.read(PIECE_BYTES):
            return piece
        if await process.wait():
            message = (await errors.read(PIECE_BYTES)).decode("utf-8", "replace")
            raise JobError(text.line(message).removeprefix("fishctl: "))
        return b""

    try:
        yield read
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def _send(
    request: web.Request, read: Read, name: str, check: Callable[[], object]
) -> web.StreamResponse:
    """Send a file of this name; raise `JobError` before it begins, `ConnectionError` later."""
    piece = await read()
    response = web.StreamResponse()
    response.content_type = "application/octet-stream"
    response.headers["Content-Disposition"] = f"attachment; filename*=UTF-8''{quote(name, safe='')}"
    finish(response)
    await response.prepare(request)
    try:
        while piece:
            check()
            async with asyncio.timeout(STALL_TIMEOUT_S):
                await response.write(piece)
            piece = await read()
        await response.write_eof()
    except (OSError, FishdError) as error:  # also a timeout
        if request.transport:
            request.transport.abort()  # the browser must not take a part for the whole
        raise ConnectionAbortedError(f"{name} was not sent: {text.describe_error(error)}") from None
    return response
