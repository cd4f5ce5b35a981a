"""The black box: recordings that follow one another, of which the oldest make room for new ones."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from fishd.core.errors import RecordingError
from fishd.recording.folder import new_path, paths
from fishd.recording.part_file import PART, is_being_written
from fishd.recording.recorder import RESERVE
from fishd.recording.recover import RECOVERING, recover
from fishd.recording.writer import RunWriter

PREFIX = "blackbox-"
"""Begins the name of its files; no others are ever removed."""
LONGEST = 3600.0
"""Length of a file [s]."""
SHARE = 1 / 8
"""A file is closed when it has this share of the room, so that little is lost with the oldest."""


class BlackBox:
    """Opens one file after another in a folder, and keeps all of them below a size."""

    def __init__(self, folder: Path, keep: int, open_writer: Callable[[Path], RunWriter]) -> None:
        """
        keep: size of all its files together, the present one included [bytes]
        open_writer: begins a recording with this path
        """
        self._folder, self._keep, self._open_writer = folder, keep, open_writer
        self._opened = 0.0

    def open(self) -> RunWriter:
        """Begin a file; those that were cut off, by a power cut say, are finished first."""
        for copy in self._folder.glob(f"{PREFIX}*{RECOVERING}"):
            if not is_being_written(copy):  # left by a kill
                with suppress(OSError):
                    copy.unlink()
        self._make_room(0)
        for path in self._own():
            if path.name.endswith(PART) and not is_being_written(path):
                with suppress(RecordingError):  # what cannot be finished goes when it is the oldest
                    recover(path)
        self._opened = time.monotonic()
        return self._open_writer(new_path(self._folder, PREFIX))

    def due(self, writer: RunWriter) -> bool:
        """Is it time for the next file?"""
        self._make_room(2 * RESERVE - writer.free())
        old = time.monotonic() - self._opened >= LONGEST
        return old or writer.size >= self._keep * SHARE

    def _make_room(self, missing: int) -> None:
        """Remove its oldest files where all together are too long, or the disk is almost full.

        missing: how much more room the disk needs [bytes]
        """
        sizes = {}
        for path in self._own():
            with suppress(OSError):
                sizes[path] = path.stat().st_size
        excess = max(missing, sum(sizes.values()) - round(self._keep * (1 - SHARE)))
        for path, size in sizes.items():
            if excess <= 0:
                return
            if not is_being_written(path):
                with suppress(OSError):
                    path.unlink()
                    excess -= size

    def _own(self) -> list[Path]:
        return [path for path in paths(self._folder) if path.name.startswith(PREFIX)]
