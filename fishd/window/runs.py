"""Runs: the recordings and experiments of a folder, their pictures, and what an end left of one."""

import asyncio
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from fishd.core import files, text
from fishd.core.decoding import decoder
from fishd.window.children import JobError, call

RUNS_AGE_S = 1.0
"""Longest age of a list of runs [s]."""
MAX_WAITING_PLOTS = 8
MAX_HEADER_BYTES = 2**20
_RUN_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. -]{0,199}", re.A)


class Header(Struct):
    """Part of the header of an experiment that the window needs."""

    kind: str
    on: str
    ended: str | None = None
    """Empty until the experiment is complete."""


_decode_header: Callable[[bytes], Header] = decoder(Header)


class Runs:
    """The runs of a folder; use it in one event loop."""

    def __init__(self, folder: Path, cache: Path) -> None:
        """cache: folder for pictures of recordings"""
        self.folder, self._cache = folder, cache
        self._list: tuple[float, Any] = (-RUNS_AGE_S, [])
        self._listing, self._plotting = asyncio.Lock(), asyncio.Lock()
        self._waiting_plots = 0

    def forget(self) -> None:
        """Read the folder again when it is listed next."""
        self._list = (-RUNS_AGE_S, [])

    def read_header(self, name: str) -> Header | None:
        """Return the header of an experiment; None if it has none that can be read."""
        try:
            path = self.folder / name / "experiment.json"
            return _decode_header(files.read(path, MAX_HEADER_BYTES, "an experiment"))
        except (files.FileProblem, msgspec.DecodeError):
            return None

    async def list_all(self) -> Any:
        """Return recordings and experiments as `fishctl runs --json` does; raise `JobError`."""
        async with self._listing:
            read, runs = self._list
            if time.monotonic() - read >= RUNS_AGE_S:
                self.folder.mkdir(parents=True, exist_ok=True)
                runs = []
                if not _is_empty(self.folder):  # saves a process for each page of a new window
                    runs = await self._list_folder()
                self._list = (time.monotonic(), runs)
            return runs

    async def _list_folder(self) -> Any:
        output = await call(["runs", f"--folder={self.folder}", "--json"], self.folder)
        try:
            return msgspec.json.decode(output)
        except msgspec.DecodeError:
            raise JobError(f"the runs in {self.folder} could not be listed") from None

    async def plot(self, name: str) -> bytes:
        """Return the picture of a recording, or of an experiment; raise `JobError`."""
        if not _RUN_NAME.fullmatch(name):
            raise JobError(f"'{text.quoted(name)}' is not the name of a run")
        experiment = self.folder / name
        if experiment.is_dir():
            picture = next(experiment.glob("*.png"), None)
            if picture is None:
                raise JobError(f"{name} has no picture: one is drawn at the end of an experiment")
            return await asyncio.to_thread(picture.read_bytes)
        if self._waiting_plots >= MAX_WAITING_PLOTS:
            raise JobError("too many pictures are being drawn; try again later")
        self._waiting_plots += 1
        try:
            async with self._plotting:
                picture = self._cache / f"{name}.png"
                if not _is_newer(picture, experiment.with_name(f"{name}.mcap")):
                    where = (f"--folder={self.folder}", f"--to={self._cache}")
                    words = ["plot", name, "--png", "--force", *where, "--json"]
                    await call(words, self.folder)
                return await asyncio.to_thread(picture.read_bytes)
        except FileNotFoundError:
            raise JobError(f"{name} could not be drawn") from None
        finally:
            self._waiting_plots -= 1


def _is_empty(folder: Path) -> bool:
    try:
        return next(folder.iterdir(), None) is None
    except OSError:
        return False


def _is_newer(file: Path, other: Path) -> bool:
    try:
        return file.stat().st_mtime > other.stat().st_mtime
    except OSError:
        return False
