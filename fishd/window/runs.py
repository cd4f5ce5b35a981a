"""Runs: the recordings and experiments of a folder, their pictures, and what an end left of one."""

import asyncio
import glob
import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from msgspec import Struct

from fishd.core import files, text
from fishd.core.decoding import decoder
from fishd.window.children import JobError, call, call_json
from fishd.window.pictures import open_picture, open_run_picture

RUNS_AGE_S = 1.0
"""Longest age of a list of runs [s]."""
MAX_HEADER_BYTES = 2**20
_RUN_NAME = re.compile(r"(?![-.~])[^/\x00-\x1f\x7f]{1,200}")


class Header(Struct):
    """Part of the header of an experiment that the window needs."""

    kind: str
    on: str
    ended: str | None = None
    """Empty until the experiment is complete."""


_decode_header: Callable[[bytes], Header] = decoder(Header)


class Runs:
    """The runs of a folder; use it in one event loop."""

    def __init__(self, folder: Path, scratch: Path) -> None:
        """scratch: folder for pictures that are drawn on request"""
        self.folder, self.scratch = folder, scratch
        self._list: tuple[float, Any] = (-RUNS_AGE_S, [])
        self._listing, self._plotting = asyncio.Lock(), asyncio.Lock()
        self._calling = asyncio.Lock()
        self._drawn: dict[str, list[tuple[str, int, int]]] = {}
        """Stamp of each run when its picture was drawn."""

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
                # A disk may stall, and an emergency stop must not wait for it.
                is_empty = await asyncio.to_thread(_is_empty, self.folder)
                # An empty folder saves a process for each page of a new window.
                words = ["runs", f"--folder={self.folder}", "--json"]
                runs = [] if is_empty else await call_json(words, self.folder)
                self._list = (time.monotonic(), runs)
            return runs

    async def plot(self, name: str) -> BinaryIO:
        """Return the picture of a run, open; draw it if it has none; raise `JobError`."""
        check_name(name)
        try:
            with suppress(files.NoFile):
                if not name.endswith((".mcap", ".part")):
                    return await asyncio.to_thread(open_run_picture, self.folder, name)
            return await self._draw(name)
        except files.FileProblem as problem:
            raise JobError(str(problem)) from None

    async def call_verb(self, verb: str, *names: str, options: Sequence[str] = ()) -> Any:
        """Return what a verb of `fishctl runs` prints as JSON, one at a time; raise `JobError`."""
        words = ["runs", verb, f"--folder={self.folder}", *options, "--json", "--", *names]
        async with self._calling:
            return await call_json(words, self.folder)

    async def change(self, verb: str, *words: str) -> Any:
        """Return what a verb of `fishctl runs` prints that changes runs; raise `JobError`."""
        try:
            return await self.call_verb(verb, *words)
        finally:
            self.forget()

    async def plot_over_each_other(self, names: Sequence[str]) -> BinaryIO:
        """Return a picture of several runs over each other, open; raise `JobError`."""
        picture = self.scratch / "compared.png"
        paths = [str(self.folder / name) for name in names]
        async with self._plotting:
            await call(["plot", "--force", f"--to={picture}", "--json", *paths], self.folder)
            return await asyncio.to_thread(picture.open, "rb")

    async def _draw(self, name: str) -> BinaryIO:
        """Return a picture of a run that is drawn here, again if it has changed."""
        try:
            async with self._plotting:
                picture = self.scratch / f"{name}.png"
                stamp = await asyncio.to_thread(_read_stamp, self.folder, name)
                if not stamp or stamp != self._drawn.get(name):
                    where = (f"--folder={self.folder}", f"--to={picture}")
                    await call(["plot", name, "--force", *where, "--json"], self.folder)
                    self._drawn[name] = stamp
                return await asyncio.to_thread(open_picture, picture, f"the picture of {name}")
        except files.NoFile:
            raise JobError(f"{name} could not be drawn") from None


def check_name(name: str) -> str:
    """Return a name that a run in the folder may have; raise `JobError` for any other one."""
    if not _RUN_NAME.fullmatch(name):
        raise JobError(f"'{text.quoted(name)}' is not the name of a run")
    return name


def _is_empty(folder: Path) -> bool:
    """Create a folder if there is none, and return whether it is empty."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return next(folder.iterdir(), None) is None
    except OSError:
        return False


def _read_stamp(folder: Path, name: str) -> list[tuple[str, int, int]]:
    """Return what changes with the files of a run: name, size and time of each."""
    stem = name.removesuffix(".part").removesuffix(".mcap")
    paths = [*folder.glob(f"{glob.escape(stem)}.*"), *(folder / name).glob("*")]
    with suppress(OSError):
        stats = [(path.name, path.stat()) for path in sorted(paths)]
        return [(name, status.st_size, status.st_mtime_ns) for name, status in stats]
    return []
